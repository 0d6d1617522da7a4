"""Collisions between the links of a robot alone, pair by pair and by their meshes, for robots that are being set up.

Planning uses :class:`apex_ompl.collision.CollisionChecker`, which is far faster and needs sphere covers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.robot.model import Robot, link_of
from apex_ompl.types import Array, Flags

ALWAYS = (
    0.95  # share of random states at which a pair that touches is taken to touch always, as MoveIt's assistant does
)


class SelfCollision:
    """Which pairs of geometries of a robot collide at a state, and how far apart they are."""

    def __init__(
        self, robot: Robot, pairs: Sequence[tuple[int, int]] | None = None,
        shapes: Mapping[int, coal.CollisionGeometry] | None = None,
    ) -> None:  # fmt: skip
        """Prepare the checks.

        Args:
            robot: The robot.
            pairs: Pairs of indices of geometries; by default all that the robot checks.
            shapes: Index -> shape in place of that of the geometry, such as its convex hull.
        """
        self.robot = robot
        self.pairs = enabled_pairs(robot) if pairs is None else list(pairs)
        self._data, self._geometry = robot.model.createData(), pin.GeometryModel()
        place = {}  # of geometries that are part of a pair
        for k in dict.fromkeys(k for pair in self.pairs for k in pair):
            item = robot.geometry.geometryObjects[k].copy()
            item.geometry = (shapes or {}).get(k, item.geometry)
            place[k] = self._geometry.addGeometryObject(item)
        for first, second in self.pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(place[first], place[second]))
        self._results = self._geometry.createData()

    def colliding(self, q: Array) -> Flags:
        """Return which pairs collide at a state, shape (pairs,)."""
        q = self.robot.to_pinocchio(q)
        pin.computeCollisions(self.robot.model, self._data, self._geometry, self._results, q, False)
        return np.array([result.isCollision() for result in self._results.collisionResults], bool)

    def colliding_among(self, q: Array, chosen: Sequence[int]) -> Flags:
        """Return which pairs of some, by their places in ``pairs``, collide at a state, shape (pairs,)."""
        found = np.zeros(len(self.pairs), bool)
        if len(chosen):
            q = self.robot.to_pinocchio(q)
            pin.updateGeometryPlacements(self.robot.model, self._data, self._geometry, self._results, q)
            for k in chosen:
                found[k] = pin.computeCollision(self._geometry, self._results, int(k))
        return found

    def hits(self, states: Iterable[Array]) -> Flags:
        """Return which pairs collide at states, shape (states, pairs)."""
        found = [self.colliding(q) for q in states]
        return np.array(found, bool).reshape(len(found), len(self.pairs))

    def distances(self, q: Array) -> Array:
        """Return the distances of the pairs at a state, shape (pairs,) [m]; negative where they overlap."""
        q = self.robot.to_pinocchio(q)
        pin.computeDistances(self.robot.model, self._data, self._geometry, self._results, q)
        return np.array([result.min_distance for result in self._results.distanceResults], float)


def enabled_pairs(robot: Robot) -> list[tuple[int, int]]:
    """Return the pairs of indices of geometries that the robot checks."""
    return [(pair.first, pair.second) for pair in robot.geometry.collisionPairs]


def are_neighbors(robot: Robot, pair: tuple[int, int]) -> bool:
    """Whether at most one joint is between the links of a pair."""
    first, second = (robot.geometry.geometryObjects[k].parentJoint for k in pair)
    return bool(robot.model.parents[first] == second or robot.model.parents[second] == first)


def links_of_pair(robot: Robot, pair: tuple[int, int]) -> tuple[str, str]:
    """Return the links of a pair of geometries, sorted."""
    first, second = sorted(link_of(robot.model, robot.geometry.geometryObjects[k]) for k in pair)
    return first, second


def shares_by_links(robot: Robot, pairs: Sequence[tuple[int, int]], hits: Flags) -> dict[tuple[str, str], float]:
    """Return pair of links -> share of states at which one of their geometries collide.

    Args:
        robot: The robot.
        pairs: Pairs of indices of geometries.
        hits: Which collide at each state, shape (states, pairs).
    """
    found: dict[tuple[str, str], Flags] = {}
    for k, pair in enumerate(pairs):
        links = links_of_pair(robot, pair)
        found[links] = hits[:, k] | found.get(links, np.zeros(len(hits), bool))
    return {links: float(some.mean()) for links, some in found.items()}
