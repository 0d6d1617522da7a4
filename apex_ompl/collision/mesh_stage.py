"""Second stage of the collision checker: Coal's meshes and solids, pair by pair, in a scene that can be edited."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from weakref import WeakKeyDictionary

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.cloud_contact import cloud_depth, nearest_balls, touches
from apex_ompl.collision.containment import ContainmentTest, containment_tests
from apex_ompl.collision.shapes import cloud_of
from apex_ompl.collision.solids import Distance, Solid, closest, hull_distance, overlaps, transform, world_boxes
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array
from apex_ompl.util.forking import ProcessLock

Manager = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager
Pair = tuple[int, int]
BOX_SLACK = ((-1e-6,) * 3, (1e-6,) * 3)  # grows boxes, so that no contact is missed by rounding [m]


@dataclass(frozen=True)
class Contact:
    """Two solids that overlap.

    Attributes:
        first: Name of a link or a held object.
        second: Name of a link, a held object, an obstacle or a fixture.
        depth: Penetration depth of the convex hulls, or into the balls of a point cloud [m].
    """

    first: str
    second: str
    depth: float

    def __str__(self) -> str:
        """Return ``left_link5 <-> table_left, 4 mm deep``."""
        return f"{self.first} <-> {self.second}, {self.depth * 1e3:.3g} mm deep"


def exact_requests(data: pin.GeometryData) -> pin.GeometryData:
    """Return ``data`` with collision requests that are as exact as possible and depend on the state alone.

    Without contacts requested, GJK stops early and misses overlaps of 0.04 mm. With a cached initial guess, the result
    at the border of contact depends on the states checked before.
    """
    _make_exact(data.collisionRequests)
    return data


def _make_exact(requests: Iterable[coal.CollisionRequest]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the deprecated flag overrides its successor
        for request in requests:
            request.enable_contact = True
            request.enable_cached_gjk_guess = False
            request.gjk_initial_guess = coal.GJKInitialGuess.DefaultGuess


_links: WeakKeyDictionary[Robot, list[coal.CollisionGeometry]] = WeakKeyDictionary()
"""Geometries of a robot's links, kept between scenes with the results computed from them."""


class MeshStage:
    """The robot, the obstacles and the held objects of a scene, checked exactly.

    Solids have numbers: the links those of the robot's geometries, the others the next ones, in the order in which they
    were added; none is used twice. States are in Pinocchio's order. Queries are safe from several threads, edits are
    not.
    """

    def __init__(self, robot: Robot) -> None:
        """Make the stage of a robot without any obstacle."""
        self._robot = robot
        self.model = robot.model
        self.data = robot.model.createData()
        self.geometry = robot.geometry.copy()
        items = self.geometry.geometryObjects
        self.links = len(items)
        shapes = _links.setdefault(robot, [item.geometry for item in items])
        self.solids = {
            k: Solid(link_of(robot.model, item), int(item.parentJoint), item.placement.copy(), shapes[k], item.name)
            for k, item in enumerate(items)
        }
        self.scene: dict[str, int] = {}
        self.held: dict[str, int] = {}
        self.touch: dict[str, frozenset[str]] = {}
        self.allowed: frozenset[frozenset[str]] = frozenset()
        self._pair_up()
        self._request = coal.CollisionRequest()
        _make_exact([self._request])
        self._next = self.links
        self._containment: dict[Pair, list[ContainmentTest]] = {}
        self.lock = ProcessLock()

    def allow(self, allowed: Iterable[frozenset[str]]) -> None:
        """Let pairs of bodies touch, by their names, besides the robot's own pairs, and no others."""
        before, self.allowed = self.allowed, frozenset(allowed)
        links = {self.solids[k].name for k in range(self.links)}
        if not any(pair <= links for pair in before ^ self.allowed):
            return
        self.geometry.removeAllCollisionPairs()
        for pair in self._robot.geometry.collisionPairs:
            if not self._may_touch(pair.first, pair.second):
                self.geometry.addCollisionPair(pair)
        self._pair_up()

    def _pair_up(self) -> None:
        """Make Pinocchio's data for the pairs of links."""
        self._link_pairs = [(p.first, p.second) for p in self.geometry.collisionPairs]
        # The manager does not keep its arguments alive; this object does.
        self.geometry_data = exact_requests(self.geometry.createData())
        self.manager = Manager(self.model, self.geometry, self.geometry_data)

    def _may_touch(self, first: int, second: int) -> bool:
        return bool(self.allowed) and frozenset((self.solids[first].name, self.solids[second].name)) in self.allowed

    def add(self, name: str, shape: coal.CollisionGeometry, pose: Array) -> int:
        """Add an obstacle at a pose in the world, shape (4, 4) [m], and return its number."""
        self.scene[name] = self._added(Solid(name, 0, pin.SE3(pose), shape))
        return self.scene[name]

    def move(self, name: str, pose: Array) -> None:
        """Move an obstacle to a pose in the world, shape (4, 4) [m]."""
        number = self.scene[name]
        self.solids[number] = self.solids[number].at(pin.SE3(pose))

    def remove(self, name: str) -> None:
        """Remove an obstacle."""
        self._removed(self.scene.pop(name))

    def attach(self, held: AttachedObject, shape: coal.CollisionGeometry, pose: Array) -> int:
        """Add a held object at a pose in the frame of its link, shape (4, 4) [m], and return its number."""
        frame = self.model.frames[self._robot.link_frame(held.link)]
        solid = Solid(held.name, int(frame.parentJoint), frame.placement * pin.SE3(pose), shape)
        self.held[held.name] = self._added(solid)
        default = (link for holder in held.holders for link in self._robot.hand_of(holder))
        self.touch[held.name] = frozenset(default if held.touch_links is None else held.touch_links)
        return self.held[held.name]

    def detach(self, name: str) -> None:
        """Remove a held object."""
        self._removed(self.held.pop(name))
        del self.touch[name]

    def _added(self, solid: Solid) -> int:
        number = self._next
        self._next += 1
        self.solids[number] = solid
        return number

    def _removed(self, number: int) -> None:
        del self.solids[number]
        self._containment = {pair: tests for pair, tests in self._containment.items() if number not in pair}

    @property
    def moving(self) -> list[int]:
        """Numbers of the links that move and of held objects."""
        return [*(k for k in range(self.links) if self.solids[k].joint > 0), *self.held.values()]

    @property
    def body_pairs(self) -> list[Pair]:
        """Pairs of links and held objects that are checked against each other."""
        return self._link_pairs + self._held_pairs()

    @property
    def pairs(self) -> list[Pair]:
        """All pairs that are checked: those of bodies, and each moving body with each obstacle."""
        among = [(i, j) for i in self.moving for j in self.scene.values() if not self._may_touch(i, j)]
        return self.body_pairs + among

    @property
    def allowed_obstacles(self) -> list[Pair]:
        """Pairs of a link or held object and an obstacle that may touch."""
        bodies = (*range(self.links), *self.held.values())
        named = [pair for names in self.allowed for pair in permutations(names) if pair[1] in self.scene]
        return [(i, self.scene[other]) for name, other in named for i in bodies if self.solids[i].name == name]

    def _held_pairs(self) -> list[Pair]:
        """Return the pairs of held objects with links and with each other."""
        pairs, held = [], list(self.held.values())
        for name, i in self.held.items():
            for j in range(self.links):
                apart = self.solids[i].joint != self.solids[j].joint or self.solids[j].joint == 0
                if apart and self.solids[j].name not in self.touch[name]:
                    pairs.append((i, j))
        pairs += [(i, j) for i in held for j in held if i < j and self.solids[i].joint != self.solids[j].joint]
        return [pair for pair in pairs if not self._may_touch(*pair)] if self.allowed else pairs

    def collides(self, q: Array) -> bool:
        """Whether anything overlaps at a state in Pinocchio's order."""
        with self.lock:
            if pin.computeCollisions(self.model, self.data, self.manager, q, True):
                return True
            return any(self._overlap(pair) for pair in self._near())

    def any_collides(self, q: Array, pairs: Iterable[Pair]) -> bool:
        """Whether any of the given pairs of solids overlaps at a state in Pinocchio's order."""
        with self.lock:
            pin.forwardKinematics(self.model, self.data, q)
            return any(self._overlap(pair) for pair in pairs)

    def contacts(self, q: Array) -> list[Contact]:
        """Return all overlaps at a state in Pinocchio's order, the deepest first."""
        with self.lock:
            pin.computeCollisions(self.model, self.data, self.geometry, self.geometry_data, q, False)
            results = zip(self._link_pairs, self.geometry_data.collisionResults, strict=True)
            hits = [pair for pair, result in results if result.isCollision()]
            hits += [pair for pair in self._near() if self._overlap(pair)]
            deepest: dict[tuple[str, str], float] = {}
            obstacles = set(self.scene.values())
            for a, b in hits:
                first, second = (self.solids[k] for k in sorted((a, b), key=lambda k: (k in obstacles, k)))
                depth = self._depth(first, second)
                names = first.name, second.name
                deepest[names] = max(depth, deepest.get(names, 0.0))
        found = [Contact(a, b, depth) for (a, b), depth in deepest.items()]
        return sorted(found, key=lambda c: (-c.depth, c.first, c.second))

    def distance(self, q: Array, fixtures: bool) -> Distance:
        """Return the distance of the convex hulls of moving bodies and obstacles, of a cloud that of some balls.

        Args:
            q: State in Pinocchio's order.
            fixtures: Whether the robot's fixtures are obstacles too.
        """
        left_out = () if fixtures else {body.name for body in self._robot.fixtures}
        dynamic = [self.solids[k] for k in self.moving]
        others = [self.solids[k] for name, k in self.scene.items() if name not in left_out]
        with self.lock:
            pin.forwardKinematics(self.model, self.data, q)
            poses = [self._pose(solid) for solid in dynamic]
            boxes = world_boxes(dynamic, poses)
            others = [part for solid in others for part in nearest_balls(solid, boxes)]
            return closest(dynamic, poses, others, [solid.placement for solid in others])

    def _pose(self, solid: Solid) -> pin.SE3:
        """Return the pose of a solid in the world at the state that the joints are placed for."""
        return solid.placement if solid.joint == 0 else self.data.oMi[solid.joint] * solid.placement

    def _near(self) -> Iterator[Pair]:
        """Yield the pairs with held objects or obstacles whose boxes overlap at the current placements."""
        moving, obstacles = self.moving, list(self.scene.values())
        bodies = [*moving, *(k for k in range(self.links) if self.solids[k].joint == 0)]
        boxes = self._boxes(bodies)
        for i, j in np.argwhere(overlaps(boxes[: len(moving)], self._boxes(obstacles))).tolist():
            if not self._may_touch(moving[i], obstacles[j]):
                yield moving[i], obstacles[j]
        near, row = overlaps(boxes + BOX_SLACK, boxes), {number: k for k, number in enumerate(bodies)}
        yield from ((i, j) for i, j in self._held_pairs() if near[row[i], row[j]])

    def _boxes(self, numbers: Sequence[int]) -> Array:
        """Return the boxes around solids at the current placements, shape (n, 2, 3) [m]."""
        solids = [self.solids[k] for k in numbers]
        return world_boxes(solids, [self._pose(solid) for solid in solids])

    def _depth(self, first: Solid, second: Solid) -> float:
        """Return how deep two solids overlap at the current placements: their hulls, or the balls of a cloud."""
        at, there = self._pose(first), self._pose(second)
        cloud = cloud_of(second.shape)
        if cloud is not None:
            return cloud_depth(cloud, first, there.inverse() * at)
        return -hull_distance(first, at, second, there).value

    def _overlap(self, pair: Pair) -> bool:
        """Whether two solids overlap at the current placements, or one contains the other."""
        first, second = self.solids[pair[0]], self.solids[pair[1]]
        at, there = self._pose(first), self._pose(second)
        if cloud_of(second.shape) is not None:
            return touches(second.shape, first.shape, there.inverse() * at)
        result = coal.CollisionResult()
        if coal.collide(first.shape, transform(at), second.shape, transform(there), self._request, result):
            return True
        if max(pair) < self.links:  # a chain of links cannot enter a closed surface without crossing it
            return False
        tests = self._containment.get(pair)
        if tests is None:
            tests = self._containment[pair] = containment_tests(first, second)
        return any(test.holds(*((at, there) if test.outer_first else (there, at)), self._request) for test in tests)
