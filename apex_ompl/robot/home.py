"""The search for a home: a state that is free of self-collision, off the limits and away from singularities."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.errors import RobotError
from apex_ompl.robot.model import Robot
from apex_ompl.robot.self_collision import SelfCollision, are_neighbors, links_of_pair
from apex_ompl.types import Array, Flags

MARGIN = 0.02  # least distance of a home from limits, as a share of the range of a joint
ROOM = 0.02  # wanted distance between links at home [m]
TRIED = 20  # best states whose distances are measured
MORE = 20  # times as many states that are tried where none is free
ARM = 0.5  # length by which rotations are compared with translations [m]


class Home(NamedTuple):
    """A home.

    Attributes:
        q: The state, rounded to a thousandth.
        note: How it was found.
    """

    q: list[float]
    note: str


def find_home(
    robot: Robot, always: Collection[tuple[str, str]], states: Array, hits: Flags, wanted: Mapping[str, float]
) -> Home:
    """Return a home of a robot.

    Args:
        robot: The robot.
        always: Pairs of links that do not count.
        states: Random states, shape (N, dof).
        hits: Which of the robot's pairs collide there, shape (N, pairs).
        wanted: Joint -> value of a state of an SRDF.

    Raises:
        RobotError: No state is free.
    """
    checks = SelfCollision(robot)
    counts = np.array([links_of_pair(robot, pair) not in always for pair in checks.pairs], bool)
    checks = SelfCollision(robot, [pair for pair, use in zip(checks.pairs, counts, strict=True) if use])
    given = np.array([wanted.get(name, 0.0) for name in robot.joint_names])
    given = _inside(robot, given)
    free = states[~hits[:, counts].any(axis=1)] if len(states) else states
    if len(wanted) == robot.dof:
        if not checks.colliding(given).any():
            return Home(_rounded(given), "the state of the SRDF, which is free")
        free = _enough(robot, checks, free)
        low, high = robot.range_around()
        near = free[np.abs((robot.turned_to(free, given) - given) / (high - low)).sum(axis=1).argsort()]
        return _first(robot, checks, near, "the free one of random states that is closest to the SRDF's, which touches")
    free = _enough(robot, checks, free)
    alike = _alike(robot, free)
    free = np.concatenate([alike[~checks.hits(alike).any(axis=1)], free, given[None]])
    score = np.array([_quality(robot, q) for q in free])
    best = free[np.argsort(-score)]
    return _first(robot, checks, best, "searched, free, off the limits and away from singularities (guessed)")


def _first(robot: Robot, checks: SelfCollision, states: Array, note: str) -> Home:
    """Return the first of some states at which links have room, else the one where they have most."""
    rounded = [q for state in states[:TRIED] if not checks.colliding(q := np.array(_rounded(state))).any()]
    if not rounded:
        raise _none(robot, checks)
    apart = SelfCollision(robot, [pair for pair in checks.pairs if not are_neighbors(robot, pair)])
    room = [float(apart.distances(q).min(initial=np.inf)) for q in rounded]
    best = next((k for k, distance in enumerate(room) if distance >= ROOM), int(np.argmax(room)))
    return Home(
        _rounded(rounded[best]), f"{note}; links are {room[best] * 1e3:.0f} mm apart" * (room[best] < 1e3) or note
    )


def _enough(robot: Robot, checks: SelfCollision, free: Array) -> Array:
    """Return free states, more of them where there are none yet.

    Raises:
        RobotError: None is found.
    """
    rng = np.random.default_rng(1)
    for _ in range(MORE if not len(free) else 0):
        states = robot.random_state(rng, 200)
        free = states[~checks.hits(states).any(axis=1)]
        if len(free):
            break
    if not len(free):
        raise _none(robot, checks)
    return np.array([_inside(robot, q) for q in free])


def _none(robot: Robot, checks: SelfCollision) -> RobotError:
    hits = checks.hits(robot.random_state(np.random.default_rng(2), 100)).mean(axis=0)
    worst = " and ".join(links_of_pair(robot, checks.pairs[int(np.argmax(hits))]))
    return RobotError(f"{robot.name}: no state free of self-collision was found; {worst} touch in {hits.max():.0%}")


def _inside(robot: Robot, q: Array) -> Array:
    low, high = robot.range_around()
    room = MARGIN * (high - low)
    return np.asarray(np.clip(q, low + room, high - room))


def _rounded(q: Array) -> list[float]:
    return [round(float(value), 3) + 0.0 for value in q]


def _alike(robot: Robot, states: Array) -> Array:
    """Return states whose groups all stand as the first, with joints whose limits are mirrored turned round."""
    groups = list(robot.groups.values())
    alike = states.copy()
    low, high = robot.range_around()
    first = groups[0]
    for group in groups[1:]:
        if len(group) != len(first):
            continue
        for mine, other in zip(group, first, strict=True):
            mirrored = math.isclose(low[mine], -high[other]) and math.isclose(high[mine], -low[other])
            same = math.isclose(low[mine], low[other]) and math.isclose(high[mine], high[other])
            if same or mirrored:
                alike[:, mine] = states[:, other] if same else -states[:, other]
    return alike


def _quality(robot: Robot, q: Array) -> float:
    """Return how good a home a state is: the least singular value of an arm, less where joints are close to limits."""
    model, data = robot.model, robot.model.createData()
    pin.computeJointJacobians(model, data, robot.to_pinocchio(q))
    low, high = robot.range_around()
    span = np.minimum(high, math.pi) - np.maximum(low, -math.pi)
    room = np.minimum(q - np.maximum(low, -math.pi), np.minimum(high, math.pi) - q) / np.where(span > 0, span, 1.0)
    least = math.inf
    for group in robot.groups.values():
        joint = model.getJointId(robot.joint_names[group[-1]])
        jacobian = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        columns = [model.joints[model.getJointId(robot.joint_names[k])].idx_v for k in group]
        moved = jacobian[:, columns] * np.array([1, 1, 1, ARM, ARM, ARM])[:, None]
        least = min(least, float(np.linalg.svd(moved, compute_uv=False).min()))
    turned = float(np.mean(np.abs(q) / np.maximum(np.abs(low), np.abs(high)).clip(max=math.pi)))
    return least * min(1.0, 5.0 * max(float(room.min()), 0.0)) * max(1.0 - 0.5 * turned, 0.0)
