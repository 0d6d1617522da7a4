"""A survey of a robot: what of it is free, and what its sphere covers prove.

States that the covers do not prove free are checked by meshes, which is slow, and where most are not, the compiled
search finds no paths. The pairs of links that spoil most proofs are named.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.collision.cover.neighbors import grazing_links
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.robot.self_collision import SelfCollision, shares_by_links
from apex_ompl.scene.meshes import is_watertight, triangles
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_seed

SAMPLES = 1000
PAIR_SAMPLES = 300  # at which all pairs of meshes are checked
WIDE = 4.0 * math.pi + 1e-6  # range from which a joint counts as one without limits [rad or m]

Links = tuple[str, str]


class Survey(NamedTuple):
    """What random states of a robot show.

    Attributes:
        samples: Number of random states inside the limits.
        free: Share of them that are free of self-collision.
        proved: Share of the free states that the sphere covers prove free; NaN where none is free.
        spoilers: Pair of links -> share of the free states at which it is not proved apart, largest first.
        always: Pairs of links that touch at all of ``pair_samples`` states.
        never: Pairs that are checked and touch at none of them.
        grazing: Pairs that are not checked although they touch, as bearings do, by what ``robot prepare`` allows.
        pair_samples: Number of states for the pairs.
        home: The reason for which the home is not free, or an empty string.
        open_meshes: Links with meshes that are not watertight.
        unlimited: Joints without limits worth the name.
    """

    samples: int
    free: float
    proved: float
    spoilers: dict[Links, float]
    always: tuple[Links, ...]
    never: tuple[Links, ...]
    grazing: tuple[Links, ...]
    pair_samples: int
    home: str
    open_meshes: tuple[str, ...]
    unlimited: tuple[str, ...]


def survey(robot: Robot, samples: int = SAMPLES, seed: int = 0) -> Survey:
    """Check random states of a robot, without obstacles.

    Args:
        robot: The robot.
        samples: Number of states.
        seed: Of the states.

    Raises:
        ParameterError: The number or the seed is out of range.
    """
    samples = check_integer(samples, "samples", 1)
    states = robot.random_state(np.random.default_rng(check_seed(seed)), samples)
    checker = CollisionChecker(robot)
    free = states[checker.are_free(states)]
    proved, spoilers = proved_share(checker, free)
    chosen = states[:PAIR_SAMPLES]
    checks = SelfCollision(robot)
    shares = shares_by_links(robot, checks.pairs, checks.hits(chosen))
    contacts = checker.contacts(robot.home)
    home = "" if checker.is_free(robot.home) else "touches"
    if contacts and home:
        home = f"{contacts[0].first} touches {contacts[0].second}"
    return Survey(
        samples, len(free) / samples, proved, spoilers,
        tuple(links for links, share in shares.items() if share == 1.0),
        tuple(links for links, share in shares.items() if share == 0.0),
        grazing_links(robot.disabled_pairs), len(chosen), home, open_meshes(robot), unlimited_joints(robot),
    )  # fmt: skip


def proved_share(checker: CollisionChecker, free: Array) -> tuple[float, dict[Links, float]]:
    """Return the share of free states that the covers prove free, and that of each pair that is not proved apart.

    Args:
        checker: A checker without obstacles.
        free: States that are free, shape (N, dof).
    """
    if not len(free):
        return math.nan, {}
    kernel = checker.kernel
    pairs, numbers = kernel.unproved(free)
    link = {item.name: link_of(checker.robot.model, item) for item in checker.robot.geometry.geometryObjects}
    names = [link.get(name, name) for name in kernel.robot.body_names]
    counts: Counter[Links] = Counter()
    for row, number in zip(pairs, numbers, strict=True):
        ends = [(names[int(a)], names[int(b)] if b >= 0 else "a fixture") for a, b in row[: max(int(number), 0)]]
        counts.update({(min(one), max(one)) for one in ends})
    return float((numbers == 0).mean()), {links: count / len(free) for links, count in counts.most_common()}


def open_meshes(robot: Robot) -> tuple[str, ...]:
    """Return the links with collision meshes that are not watertight, whose inside is not well defined."""
    found = []
    for item in robot.geometry.geometryObjects:
        if item.geometry.getObjectType() == coal.OT_BVH:
            vertices, faces = triangles(item.geometry)
            corners: NDArray[np.float64] = vertices[faces]
            if not is_watertight(corners):
                found.append(link_of(robot.model, item))
    return tuple(dict.fromkeys(found))


def unlimited_joints(robot: Robot) -> tuple[str, ...]:
    """Return the joints whose range is so wide that it is none."""
    low, high = robot.range_around()
    span = high - low
    return tuple(name for name, width in zip(robot.joint_names, span, strict=True) if width > WIDE)
