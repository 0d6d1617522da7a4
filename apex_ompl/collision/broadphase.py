"""A scene compiled for Pinocchio: geometry, collision pairs, data and broadphase manager."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.containment import ANCHOR_RADIUS, EnclosingMesh, Extent, anchor_points
from apex_ompl.collision.distance import HullDistances
from apex_ompl.collision.shapes import is_shell
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.scene.bodies import AttachedObject, Body
from apex_ompl.types import Array

Manager = pin.BroadPhaseManager_DynamicAABBTreeCollisionManager


@dataclass(frozen=True)
class Contact:
    """Two solids that overlap.

    Attributes:
        first: Name of a link or a held object.
        second: Name of a link, a held object, an obstacle or a fixture.
        depth: Penetration depth of the convex hulls [m].
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the deprecated flag overrides its successor
        for request in data.collisionRequests:
            request.enable_contact = True
            request.enable_cached_gjk_guess = False
            request.gjk_initial_guess = coal.GJKInitialGuess.DefaultGuess
    return data


_links: WeakKeyDictionary[Robot, list[coal.CollisionGeometry]] = WeakKeyDictionary()
"""Geometries of a robot's links, kept between scenes with what was computed of them."""


class CompiledScene:
    """The robot, the obstacles and the held objects of a scene as one Pinocchio geometry model.

    Obstacles can be moved; any other change needs a new compilation. States are in Pinocchio's order.
    """

    def __init__(
        self,
        robot: Robot,
        obstacles: Mapping[str, Body],
        attached: Mapping[str, AttachedObject],
        placed: Mapping[str, tuple[coal.CollisionGeometry, Array]],
    ) -> None:
        """Compile a scene.

        Args:
            robot: The robot.
            obstacles: Obstacles by name, the robot's fixtures included.
            attached: Held objects by name.
            placed: Geometry and pose of each of them, in the world or in the frame of the link that holds it.
        """
        self._robot = robot
        self.model = robot.model
        self.data = robot.model.createData()
        self.geometry = robot.geometry.copy()
        self.labels = [link_of(robot.model, item) for item in self.geometry.geometryObjects]
        self.links = len(self.labels)
        self.scene: dict[str, int] = {}
        self.fixtures = frozenset(body.name for body in robot.fixtures)
        for name in obstacles:
            shape, pose = placed[name]
            self.scene[name] = self._add(name, 0, 0, pin.SE3(pose), shape)
        self.held: dict[str, int] = {}
        for name, held in attached.items():
            frame = robot.model.frames[robot.link_frame(held.link)]
            shape, pose = placed[name]
            parent = robot.link_frame(held.link)
            self.held[name] = self._add(name, frame.parentJoint, parent, frame.placement * pin.SE3(pose), shape)
        self.touch: dict[str, frozenset[str]] = {}
        for name, held in attached.items():
            default = robot.hand_of(held.link)
            self.touch[name] = frozenset(default if held.touch_links is None else held.touch_links)
        self._pair_up()
        self.pairs = [(p.first, p.second) for p in self.geometry.collisionPairs]
        self.same = list(range(self.geometry.ngeoms))  # geometry -> the geometry that it is a proxy of, or itself
        self.offsets: dict[int, pin.SE3] = {}  # proxy geometry -> its pose in the frame of the original
        self.hollow: list[tuple[int, int, EnclosingMesh, pin.SE3]] = []
        self._add_containment()
        if self.hollow:
            self._posed, places = np.unique([entry[:2] for entry in self.hollow], return_inverse=True)
            self._outer, self._inner = places.reshape(-1, 2).T
            self._anchors = np.array([offset.translation for _, _, _, offset in self.hollow])
            self._boxes = np.array([mesh.box for _, _, mesh, _ in self.hollow])
            self.hollow[0][2].contains(np.zeros(3))  # compiles or loads the test
        self.geometry_data, self.manager = self._broadphase(self.geometry)
        self.lock = threading.Lock()
        self._distances: dict[str, HullDistances] = {}
        self._checks: dict[tuple[int, int], list[int]] = {}
        for k, pair in enumerate(self.geometry.collisionPairs):
            self._checks.setdefault(self._key(self.same[pair.first], self.same[pair.second]), []).append(k)
        self._hollow_of: dict[tuple[int, int], list[int]] = {}
        for k, (h, g, _, _) in enumerate(self.hollow):
            self._hollow_of.setdefault(self._key(h, g), []).append(k)

    @staticmethod
    def _key(a: int, b: int) -> tuple[int, int]:
        return (a, b) if a < b else (b, a)

    def _add(self, name: str, joint: int, frame: int, placement: pin.SE3, shape: coal.CollisionGeometry) -> int:
        self.labels.append(name)
        return int(self.geometry.addGeometryObject(pin.GeometryObject(name, joint, frame, placement, shape)))

    def _pair_up(self) -> None:
        """Add collision pairs: obstacles with moving bodies, and held objects with all that they may not touch."""
        items = self.geometry.geometryObjects
        moving = [i for i in range(self.links) if items[i].parentJoint > 0]
        held = list(self.held.values())
        pairs = [(i, j) for i in (*moving, *held) for j in self.scene.values()]
        for name, i in self.held.items():
            for j in range(self.links):
                apart = items[i].parentJoint != items[j].parentJoint or items[j].parentJoint == 0
                if apart and self.labels[j] not in self.touch[name]:
                    pairs.append((i, j))
        pairs += [(i, j) for i in held for j in held if i < j and items[i].parentJoint != items[j].parentJoint]
        for i, j in pairs:
            self.geometry.addCollisionPair(pin.CollisionPair(i, j))

    def _add_containment(self) -> None:
        """Add containment tests for every pair in which one solid may lie inside the mesh of the other.

        A convex mesh is tested by collision of its hull with anchor points of the inner solid. A mesh that is not
        convex is added to ``hollow``, to be tested by winding numbers.
        """
        items = list(self.geometry.geometryObjects)
        links = _links.setdefault(self._robot, [item.geometry for item in items[: self.links]])
        shapes = [*links, *(item.geometry for item in items[self.links :])]
        extents = [Extent.of(shape) for shape in shapes]
        hulls: dict[int, int] = {}
        anchors: dict[int, list[int]] = {}
        for a, b in self.pairs:
            if a < self.links and b < self.links:
                continue
            for h, g in ((a, b), (b, a)):
                if not is_shell(shapes[h]) or not extents[h].may_contain(extents[g]):
                    continue
                mesh = EnclosingMesh.of(shapes[h])
                points = [pin.SE3(np.eye(3), point) for point in anchor_points(shapes[g])]
                if not mesh.convex:
                    self.hollow += [(h, g, mesh, point) for point in points]
                    continue
                if h not in hulls:
                    hulls[h] = self._add_proxy(h, pin.SE3.Identity(), mesh.hull)
                if g not in anchors:
                    anchors[g] = [self._add_proxy(g, point, coal.Sphere(ANCHOR_RADIUS)) for point in points]
                for anchor in anchors[g]:
                    self.geometry.addCollisionPair(pin.CollisionPair(hulls[h], anchor))

    def _add_proxy(self, index: int, offset: pin.SE3, shape: coal.CollisionGeometry) -> int:
        item = self.geometry.geometryObjects[index]
        number = self._add(
            f"{item.name}#{len(self.same)}", item.parentJoint, item.parentFrame, item.placement * offset, shape
        )
        self.same.append(index)
        self.offsets[number] = offset
        return number

    def _broadphase(self, geometry: pin.GeometryModel) -> tuple[pin.GeometryData, Any]:
        # The manager does not keep its arguments alive; this object does.
        data = exact_requests(geometry.createData())
        return data, Manager(self.model, geometry, data)

    def place(self, name: str, placement: pin.SE3) -> None:
        """Move one obstacle."""
        index = self.scene[name]
        items = self.geometry.geometryObjects
        items[index].placement = placement
        for number, offset in self.offsets.items():
            if self.same[number] == index:
                items[number].placement = placement * offset
        self._distances.clear()

    def collides(self, q: Array) -> bool:
        """Whether anything overlaps at a state in Pinocchio's order."""
        with self.lock:
            if pin.computeCollisions(self.model, self.data, self.manager, q, True):
                return True
            return bool(self.hollow) and any(True for _ in self._contained())

    def any_collides(self, q: Array, pairs: Iterable[tuple[int, int]]) -> bool:
        """Whether any of the given pairs of geometries overlaps at a state in Pinocchio's order."""
        with self.lock:
            pin.updateGeometryPlacements(self.model, self.data, self.geometry, self.geometry_data, q)
            keys = [self._key(a, b) for a, b in pairs]
            checks = (k for key in keys for k in self._checks[key])
            if any(pin.computeCollision(self.geometry, self.geometry_data, k) for k in checks):
                return True
            return any(self._inside(k) for key in keys for k in self._hollow_of.get(key, ()))

    def _inside(self, k: int) -> bool:
        """Whether the anchor point of a containment test is inside, at the current placements of the geometries."""
        h, g, mesh, offset = self.hollow[k]
        placements = self.geometry_data.oMg
        return mesh.contains(placements[h].actInv(placements[g].act(offset.translation)))

    def _contained(self) -> Iterator[tuple[int, int]]:
        """Yield the pairs of a hollow mesh and a geometry entirely inside it, at the current placements."""
        placements = self.geometry_data.oMg
        poses = np.array([placements[i].homogeneous for i in self._posed.tolist()])
        outer, inner = poses[self._outer], poses[self._inner]
        world = (inner[:, :3, :3] @ self._anchors[:, :, None])[:, :, 0] + inner[:, :3, 3]
        points = ((world - outer[:, :3, 3])[:, None] @ outer[:, :3, :3])[:, 0]
        near = ((points >= self._boxes[:, 0]) & (points <= self._boxes[:, 1])).all(axis=1)
        for k in np.flatnonzero(near).tolist():
            h, g, mesh, _ = self.hollow[k]
            if mesh.contains(points[k]):
                yield h, g

    def contacts(self, q: Array) -> list[Contact]:
        """Return all overlaps at a state in Pinocchio's order, the deepest first."""
        with self.lock:
            pin.computeCollisions(self.model, self.data, self.geometry, self.geometry_data, q, False)
            hits = [
                (self.same[p.first], self.same[p.second])
                for p, result in zip(self.geometry.collisionPairs, self.geometry_data.collisionResults, strict=True)
                if result.isCollision()
            ]
            hits += list(self._contained()) if self.hollow else []
        deepest: dict[tuple[str, str], float] = {}
        for first, second in hits:
            pair = (first, second) if first < second else (second, first)
            names = (self.labels[pair[0]], self.labels[pair[1]])
            depth = -float(HullDistances(self.model, self.geometry, [pair], self.labels).values(q)[0])
            deepest[names] = max(depth, deepest.get(names, 0.0))
        found = [Contact(a, b, depth) for (a, b), depth in deepest.items()]
        return sorted(found, key=lambda c: (-c.depth, c.first, c.second))

    def distances(self, which: str) -> HullDistances:
        """Return the distances of a set of pairs.

        Args:
            which: ``scene`` for robot and held objects against obstacles, or ``all`` for the same with fixtures.
        """
        if which not in self._distances:
            targets = {i for n, i in self.scene.items() if which == "all" or n not in self.fixtures}
            chosen = [(a, b) for a, b in self.pairs if b in targets]
            self._distances[which] = HullDistances(self.model, self.geometry, chosen, self.labels)
        return self._distances[which]
