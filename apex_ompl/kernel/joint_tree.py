"""The tree of a robot's joints, the clusters of bodies that follow from it, and balls around these and their parts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import NamedTuple, TypeVar, cast

import numpy as np

from apex_ompl.kernel.compiled.arrays import BINS, FIXED, LIMIT_SLACK, PRISMATIC, REVOLUTE
from apex_ompl.kernel.compiled.geometry.enclosing_ball import enclose
from apex_ompl.kernel.products import product
from apex_ompl.kernel.tables import BodySpec, JointSpec
from apex_ompl.types import Array
from apex_ompl.util.arrays import length

OF_BIN = 4  # steps between the values at which balls are made, in a range of values
SAMPLES = OF_BIN * BINS + 1  # of these values


class ClusterBall(NamedTuple):
    """Ball around a cluster in the frame of its joint.

    Attributes:
        center: Shape (3,) [m].
        radius: Radius around the solids [m].
        outer: Radius around the leaf spheres [m].
        spread: Largest distance of a sphere's center from that of the ball [m].
        speed: Largest speed of such a center, per unit of the inner planned joint.
    """

    center: Array
    radius: float
    outer: float
    spread: float
    speed: float


class Member(NamedTuple):
    """A body of a cluster.

    Attributes:
        joint: Its joint.
        centers: Centers of its spheres in the joint's frame, shape (n, 3) [m].
        radii: Shape (n,) [m].
        outer: Radii around the leaves below each, shape (n,) [m].
    """

    joint: int
    centers: Array
    radii: Array
    outer: Array


class PlacedBody(NamedTuple):
    """Spheres of a body in the frame of its joint.

    Attributes:
        centers: Shape (n, 3) [m].
        outer: Radii of :func:`leaf_radii`, shape (n,) [m].
        inner: Centers and radii of balls inside of the solid, shape (k, 4) [m].
    """

    centers: Array
    outer: Array
    inner: Array


def _motions(joint: JointSpec, q: Array) -> Array:
    """Return the motion of a joint at values of its planned joint, shape (N, 4, 4)."""
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    values = joint.ratio * q + joint.shift
    if joint.kind == REVOLUTE:
        c, s = np.cos(values), np.sin(values)
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    elif joint.kind == PRISMATIC:
        poses[:, 2, 3] = values
    return poses


def leaf_radii(centers: Array, radii: Array, body: BodySpec) -> Array:
    """Return for each node a radius around all leaves below it."""
    above = np.full(len(radii), -1)
    for k in np.flatnonzero(body.count):
        above[body.first[k] : body.first[k] + body.count[k]] = k
    leaves = np.flatnonzero(np.asarray(body.count) == 0)
    outer, at = np.zeros(len(radii)), leaves
    while len(leaves):
        np.maximum.at(outer, at, np.linalg.norm(centers[leaves] - centers[at], axis=1) + radii[leaves])
        at = above[at]
        leaves, at = leaves[at >= 0], at[at >= 0]
    return outer + 1e-12


def transformed(pose: Array, points: Array) -> Array:
    """Return points, shape (n, 3), after poses, shape (..., 4, 4): shape (..., n, 3)."""
    return product(points, np.swapaxes(pose[..., :3, :3], -1, -2)) + pose[..., None, :3, 3]


MOST_KEPT = 2000  # balls and radii
MOST_PARTS = 62  # of a cluster: bits of a number

T = TypeVar("T")


def turn_to(axis: Array | None) -> Array:
    """Return the rotation by which the kernel turns a joint's frame, so that ``axis`` is its z; shape (4, 4)."""
    turn = np.eye(4)
    if axis is not None:
        z = np.asarray(axis, float) / length(axis)
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * float((x * z).sum())
        x /= length(x)
        turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


class JointTree:
    """Joints with their axes along z.

    Attributes:
        joints: The joints, the world first, parents before their children.
        turns: Rotation of each joint's frame that takes its axis to z, shape (4, 4).
        placements: Pose of each turned frame in that of its parent, shape (4, 4) [m].
        chains: Numbers of each joint and of those above it, up to the world.
        home: Joint of the cluster of each joint's bodies: the joint itself, or the one that carries the hand.
    """

    def __init__(self, joints: Sequence[JointSpec], endless: Collection[int] = ()) -> None:
        """Read the joints.

        Args:
            joints: The joints, parents before their children.
            endless: Planned joints without a range, of which no bodies share a cluster: balls are made over ranges.
        """
        self.joints = tuple(joints)
        self.turns = [turn_to(joint.axis if joint.kind != FIXED else None) for joint in joints]
        self.placements = [np.eye(4)]
        self.chains = [[0]]
        for k, joint in enumerate(joints[1:], start=1):
            placement = np.eye(4) if joint.placement is None else joint.placement
            self.placements.append(product(product(self.turns[joint.parent].T, placement), self.turns[k]))
            self.chains.append([k, *self.chains[joint.parent]])
        drivers = [joint.source for joint in joints if joint.kind != FIXED]
        self._below = Counter(joint.parent for joint in joints[1:])
        self._shared = {source for source in drivers if drivers.count(source) > 1 and source not in endless}
        self._fingers = [self._is_finger(k) for k in range(len(joints))]
        self.home = [self._cluster_joint(k) for k in range(len(joints))]
        self._known: dict[tuple[object, ...], object] = {}

    def inner(self, top: int) -> list[int]:
        """Return the joints below ``top`` whose bodies are in its cluster, branch by branch, parents first."""
        return self._kept(("inner", top), lambda: self._inner(top))

    def _inner(self, top: int) -> list[int]:
        joints = range(1, len(self.joints))
        found = [k for k in joints if k != top and self.home[k] == top and top in self.chains[k]]
        return [k for _, k in sorted((self.branch(k, top), k) for k in found)]

    def placed(self, body: BodySpec) -> PlacedBody:
        """Return what is in the frame of a body's joint; it is kept."""
        arrays = body.placement, body.centers, body.radii, body.first, body.count, body.inner
        return self._kept((body.joint, *(np.asarray(one).tobytes() for one in arrays)), lambda: self._placed(body))

    def _placed(self, body: BodySpec) -> PlacedBody:
        frame, radii = product(self.turns[body.joint].T, body.placement), np.asarray(body.radii, float)
        centers = transformed(frame, np.asarray(body.centers, float))
        inner = np.column_stack([transformed(frame, body.inner[:, :3]), body.inner[:, 3]])
        return PlacedBody(centers, leaf_radii(centers, radii, body), inner)

    def ball(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float] | None
    ) -> ClusterBall:
        """Return the ball around a cluster; it is kept.

        Inner joints are sampled over their range; between two samples a center moves by at most its speed times half
        the spacing.

        Args:
            members: Bodies of the cluster.
            top: Joint of the cluster.
            inner: Its inner joints, parents first.
            limits: Range of the planned joint that drives the inner joints, None where there is none.
        """
        content = tuple((m.joint, m.centers.tobytes(), m.radii.tobytes(), m.outer.tobytes()) for m in members)
        key = top, tuple(inner), limits, content
        return self._kept(key, lambda: self._ball(members, top, inner, limits))

    def _ball(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float] | None
    ) -> ClusterBall:
        low, high = limits or (0.0, 0.0)
        points = self._points(members, top, inner, (low, high), 1 if limits is None else SAMPLES)
        radii = np.concatenate([m.radii for m in members])
        roots = np.cumsum([0, *(len(m.radii) for m in members[:-1])])
        speeds = np.concatenate([self._speed(m, top, (low, high)) for m in members])
        slack = np.zeros(len(radii)) if limits is None else speeds * (high - low) / (SAMPLES - 1) / 2.0
        center, away = np.empty(3), np.empty(len(radii))
        enclose(points, roots, (radii + slack)[roots], center, away)
        away += slack
        leaves = np.concatenate([m.outer for m in members])
        # The roots contain the solids; the leaves and inner nodes are what moves.
        return ClusterBall(
            center, float((away + radii)[roots].max()) + 1e-9, float((away + leaves)[roots].max()) + 1e-9,
            float(away.max()) + 1e-9, float(speeds.max()),
        )  # fmt: skip

    def part_balls(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float] | None
    ) -> tuple[Array, Array]:
        """Return balls around a part of a cluster for each of BINS ranges of values; they are kept.

        Args are those of :meth:`ball`, but for the limits, which are the robot's own and hold within LIMIT_SLACK.

        Returns:
            Centers and radii around the solids, shape (BINS, 4), from the lowest limit to the highest, and radii around
            the leaf spheres, shape (BINS,) [m].
        """
        content = tuple((m.joint, *(array[:1].tobytes() for array in m[1:])) for m in members)
        key = "part", top, tuple(inner), limits, content
        return self._kept(key, lambda: self._part_balls(members, top, inner, limits))

    def _part_balls(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float] | None
    ) -> tuple[Array, Array]:
        low, high = limits or (0.0, 0.0)
        roots = [Member(m.joint, m.centers[:1], m.radii[:1], m.outer[:1]) for m in members]
        points = self._points(roots, top, inner, (low, high), SAMPLES)
        speeds = np.concatenate([self._speed(m, top, (low, high)) for m in roots])
        slack = speeds * ((high - low) / (SAMPLES - 1) / 2.0 + LIMIT_SLACK)
        rows = OF_BIN * np.arange(BINS)[:, None] + np.arange(OF_BIN + 1)
        within = points[rows]  # (BINS, OF_BIN + 1, bodies, 3)
        radii, leaves = np.concatenate([m.radii for m in roots]), np.concatenate([m.outer for m in roots])
        wide = (radii + slack)[:, None]
        center = 0.5 * ((within - wide).min(axis=(1, 2)) + (within + wide).max(axis=(1, 2)))
        away = np.linalg.norm(within - center[:, None, None], axis=3).max(axis=1) + slack
        return np.column_stack([center, (away + radii).max(axis=1) + 1e-9]), (away + leaves).max(axis=1) + 1e-9

    def _points(
        self, members: Sequence[Member], top: int, inner: Sequence[int], limits: tuple[float, float], count: int
    ) -> Array:
        """Return centers of spheres at values of the inner joints, in the frame of the cluster's, (count, n, 3) [m].

        Those that move are kept.
        """
        moving, found = (top, tuple(inner), limits, count), list[Array]()

        def poses() -> dict[int, Array]:
            values, known = np.linspace(*limits, count), {top: np.tile(np.eye(4), (count, 1, 1))}
            for k in inner:
                up = product(known[self.joints[k].parent], self.placements[k])
                known[k] = product(up, _motions(self.joints[k], values))
            return known

        def placed(joint: int, centers: Array) -> Array:
            return transformed(self._kept(("poses", *moving), poses)[joint], centers)

        for joint, centers, *_ in members:
            if joint == top:
                found.append(np.broadcast_to(centers, (count, *centers.shape)))
            else:
                key = "points", *moving, joint, centers.tobytes()
                found.append(self._kept(key, partial(placed, joint, centers)))
        return np.ascontiguousarray(np.concatenate(found, axis=1))

    def _speed(self, body: Member, top: int, limits: tuple[float, float]) -> Array:
        """Bound the speed of a body's spheres relative to the cluster's joint, per unit of the planned joint."""
        reach = np.linalg.norm(body.centers, axis=1)
        speed = np.zeros(len(reach))
        k = body.joint
        while k != top:
            joint = self.joints[k]
            if joint.kind == REVOLUTE:
                speed += abs(joint.ratio) * reach
            elif joint.kind == PRISMATIC:
                speed += abs(joint.ratio)
                reach = reach + max(abs(joint.ratio * v + joint.shift) for v in limits)
            reach = reach + np.linalg.norm(self.placements[k][:3, 3])
            k = joint.parent
        return speed

    def branch(self, joint: int, top: int) -> int:
        """Return the joint below ``top`` that a joint is or hangs at; ``top`` itself, too, where there are many."""
        chain = self.chains[joint]
        return top if self._below[top] >= MOST_PARTS else chain[max(chain.index(top) - 1, 0)]

    def _kept(self, key: tuple[object, ...], make: Callable[[], T]) -> T:
        found = self._known.get(key)
        if found is None:
            found = make()
            if len(self._known) >= MOST_KEPT:
                self._known.clear()
            self._known[key] = found
        return cast(T, found)

    def _is_finger(self, k: int) -> bool:
        joint = self.joints[k]
        if k == 0:
            return False
        if joint.kind == FIXED:
            return self._is_finger(joint.parent)
        return joint.source in self._shared

    def _cluster_joint(self, k: int) -> int:
        """Return the joint of the cluster of a joint's bodies.

        Joints of which several follow one planned joint are taken for fingers, as long as one planned joint drives
        all of what hangs there.
        """
        top = next(x for x in self.chains[k] if not self._fingers[x])
        below = [i for i in range(len(self.joints)) if i != top and top in self.chains[i]]
        fingers = [i for i in below if self.joints[i].kind != FIXED and self._all_fingers(i, top)]
        driven = {self.joints[i].source for i in fingers}
        carried = any(not self._fingers[i] and any(self._fingers[x] for x in self.chains[i]) for i in below)
        return k if carried or len(driven) > 1 else top

    def _all_fingers(self, k: int, top: int) -> bool:
        chain = self.chains[k]
        return all(self._fingers[x] for x in chain[: chain.index(top)])
