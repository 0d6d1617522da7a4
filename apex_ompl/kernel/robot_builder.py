"""From joints, covered bodies and pairs to the arrays of a robot; numpy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.arrays import FIXED, PRISMATIC, REVOLUTE, RobotArrays
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.types import Array

SAMPLES = 65  # of a cluster's inner joint, when its ball is made


@dataclass(frozen=True)
class JointSpec:
    """A joint of a tree; number 0 is the world, and parents come before their children.

    Attributes:
        parent: Number of the parent.
        kind: FIXED, REVOLUTE or PRISMATIC.
        placement: Pose in the parent's frame at value 0, shape (4, 4) [m].
        axis: Unit vector in the joint's own frame, shape (3,).
        source: Planned joint that drives it.
        ratio: Value of the joint is ``ratio * q[source] + shift``; mimic joints share a source.
        shift: See ``ratio``.
    """

    parent: int
    kind: int = FIXED
    placement: Array | None = None
    axis: Array | None = None
    source: int = -1
    ratio: float = 1.0
    shift: float = 0.0


@dataclass(frozen=True)
class BodySpec:
    """A solid fixed to a joint, and the tree of spheres that contains it.

    Attributes:
        name: Name of the body.
        joint: Number of its joint.
        placement: Pose of the spheres' frame in the joint's, shape (4, 4) [m].
        centres: Shape (n, 3) [m]; node 0 is the root.
        radii: Shape (n,) [m].
        first: First child of each node, shape (n,).
        count: Number of children of each node, 0 for leaves, shape (n,).
        meets_scene: Whether it is judged against obstacles.
    """

    name: str
    joint: int
    placement: Array
    centres: Array
    radii: Array
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    meets_scene: bool = True


def robot_tables(
    name: str,
    joint_names: Sequence[str],
    *,
    lower: Array,
    upper: Array,
    joints: Sequence[JointSpec],
    bodies: Sequence[BodySpec],
    pairs: Sequence[tuple[int, int]],
    numbers: Sequence[int] | None = None,
) -> RobotTables:
    """Return the tables of a robot.

    Args:
        name: Name of the robot.
        joint_names: Planned joints in state order.
        lower: Their lowest values, shape (dof,).
        upper: Their highest values, shape (dof,).
        joints: The tree, the world first.
        bodies: The solids.
        pairs: Places of the bodies that may not touch each other.
        numbers: What the bodies go by outside of the tables; by default their places.
    """
    given = range(len(bodies)) if numbers is None else numbers
    return _Builder(joints, bodies, lower, upper).tables(name, tuple(joint_names), pairs, given)


def turn_to(axis: Array | None) -> Array:
    """Return the rotation by which the kernel turns a joint's frame, so that ``axis`` is its z; shape (4, 4)."""
    turn = np.eye(4)
    if axis is not None:
        z = np.asarray(axis, float) / np.linalg.norm(axis)
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
        turn[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return turn


class _Builder:
    """Joints with their axes along z, bodies sorted by cluster."""

    def __init__(self, joints: Sequence[JointSpec], bodies: Sequence[BodySpec], lower: Array, upper: Array) -> None:
        self.joints, self.lower, self.upper = joints, lower, upper
        turns = [turn_to(j.axis if j.kind != FIXED else None) for j in joints]
        self.placements = [np.eye(4)]
        for k, joint in enumerate(joints[1:], start=1):
            placement = np.eye(4) if joint.placement is None else joint.placement
            self.placements.append(turns[joint.parent].T @ placement @ turns[k])
        drivers = [j.source for j in joints if j.kind != FIXED]
        self.shared = {s for s in drivers if drivers.count(s) > 1}
        self.home = [self._cluster_joint(k) for k in range(len(joints))]
        keys = [self._key(b, k) for k, b in enumerate(bodies)]
        self.clusters = sorted(set(keys))
        order = sorted(range(len(bodies)), key=lambda b: (self.clusters.index(keys[b]), b))
        self.number = {b: k for k, b in enumerate(order)}  # body as given -> row
        self.bodies = [bodies[b] for b in order]
        self.cluster_of = [self.clusters.index(keys[b]) for b in order]
        self.centres = [
            _transform(turns[b.joint].T @ np.asarray(b.placement, float), np.asarray(b.centres, float))
            for b in self.bodies
        ]
        self.lazy = [self._inner(j) for j, _ in self.clusters]

    def _cluster_joint(self, k: int) -> int:
        """Return the joint that a joint's bodies are looked at with: its own, or the one that carries the hand.

        Joints of which several follow one planned joint are taken for fingers, as long as one planned joint drives
        all of what hangs there.
        """
        chain = [k]
        while self._is_finger(chain[-1]):
            chain.append(self.joints[chain[-1]].parent)
        top = chain[-1]
        below = [i for i in range(len(self.joints)) if i != top and top in self._chain(i)]
        fingers = [i for i in below if self.joints[i].kind != FIXED and self._all_fingers(i, top)]
        driven = {self.joints[i].source for i in fingers}
        carried = any(not self._is_finger(i) and any(self._is_finger(x) for x in self._chain(i)) for i in below)
        return k if carried or len(driven) > 1 else top

    def _is_finger(self, k: int) -> bool:
        joint = self.joints[k]
        if k == 0:
            return False
        if joint.kind == FIXED:
            return self._is_finger(joint.parent)
        return joint.source in self.shared

    def _chain(self, k: int) -> list[int]:
        chain = [k]
        while chain[-1] > 0:
            chain.append(self.joints[chain[-1]].parent)
        return chain

    def _all_fingers(self, k: int, top: int) -> bool:
        chain = self._chain(k)
        return all(self._is_finger(x) for x in chain[: chain.index(top)])

    def _key(self, body: BodySpec, number: int) -> tuple[int, int]:
        """Return what tells clusters apart: the joint, and what a body meets; fixed bodies stand each alone."""
        home = self.home[body.joint]
        return (home, number if home == 0 else int(body.meets_scene))

    def _inner(self, top: int) -> list[int]:
        return [k for k in range(1, len(self.joints)) if k != top and self.home[k] == top and top in self._chain(k)]

    def tables(
        self, name: str, joint_names: tuple[str, ...], pairs: Sequence[tuple[int, int]], numbers: Sequence[int]
    ) -> RobotTables:
        joints, bodies = self.joints, self.bodies
        rows = sorted(self.number, key=lambda b: self.number[b])
        inner = {k for ks in self.lazy for k in ks}
        trees = [np.asarray(b.radii, float) for b in bodies]
        starts = np.cumsum([0, *(len(t) for t in trees)])
        outer = [_outer(c, r, b) for c, r, b in zip(self.centres, trees, bodies, strict=True)]
        balls = [self._ball(c, outer) for c in range(len(self.clusters))]
        pair_rows = self._pairs(pairs)
        arrays = RobotArrays(
            joint_parent=_ints([j.parent for j in joints]),
            joint_kind=_ints([j.kind for j in joints]),
            joint_source=_ints([j.source if j.kind != FIXED else -1 for j in joints]),
            eager=_ints([k for k in range(1, len(joints)) if k not in inner]),
            lazy=_ints([k for ks in self.lazy for k in ks]),
            cluster_joint=_ints([j for j, _ in self.clusters]),
            cluster_lazy=_spans([len(ks) for ks in self.lazy]),
            cluster_dof=_ints([self._dof(c) for c in range(len(self.clusters))]),
            cluster_bodies=_spans([self.cluster_of.count(c) for c in range(len(self.clusters))]),
            cluster_meets_scene=_ints([bodies[self.cluster_of.index(c)].meets_scene for c in range(len(balls))]),
            body_joint=_ints([b.joint for b in bodies]),
            body_root=_ints(starts[:-1]),
            node_first=_ints([start + k for b, start in zip(bodies, starts, strict=False) for k in b.first]),
            node_count=_ints([k for b in bodies for k in b.count]),
            pair_clusters=_ints([key for key, _, _ in pair_rows]).reshape(-1, 2),
            pair_common=_ints([common for _, common, _ in pair_rows]),
            pair_bodies=_spans([len(rows) for _, _, rows in pair_rows]),
            bodies=_ints([row for _, _, rows in pair_rows for row in rows]).reshape(-1, 2),
            joint_rotation=np.array([p[:3, :3] for p in self.placements]),
            joint_offset=np.array([p[:3, 3] for p in self.placements]),
            joint_ratio=np.array([j.ratio for j in joints], float),
            joint_shift=np.array([j.shift for j in joints], float),
            lower=np.array(self.lower, float),
            upper=np.array(self.upper, float),
            cluster_ball=np.array([[*ball[0], ball[1]] for ball in balls]).reshape(-1, 4),
            cluster_outer=np.array([ball[2] for ball in balls]),
            cluster_spread=np.array([ball[3] for ball in balls]),
            cluster_speed=np.array([ball[4] for ball in balls]),
            node_centre=np.concatenate([np.empty((0, 3)), *self.centres]),
            node_radius=np.concatenate([np.empty(0), *trees]),
            node_outer=np.concatenate([np.empty(0), *outer]),
        )
        return RobotTables(name, joint_names, tuple(b.name for b in bodies), tuple(numbers[b] for b in rows), arrays)

    def _dof(self, cluster: int) -> int:
        sources = [self.joints[k].source for k in self.lazy[cluster] if self.joints[k].kind != FIXED]
        return sources[0] if sources else -1

    def _pairs(self, pairs: Sequence[tuple[int, int]]) -> list[tuple[tuple[int, int], int, list[tuple[int, int]]]]:
        """Return pairs of clusters with their lowest common joint and the pairs of bodies."""
        rows: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for a, b in pairs:
            m, n = sorted((self.number[a], self.number[b]))
            rows.setdefault((self.cluster_of[m], self.cluster_of[n]), []).append((m, n))
        found = []
        for (c, d), members in sorted(rows.items()):
            above = set(self._chain(self.clusters[d][0]))
            common = next(k for k in self._chain(self.clusters[c][0]) if k in above)
            found.append(((c, d), common, sorted(members)))
        return found

    def _ball(self, cluster: int, outer: Sequence[Array]) -> tuple[Array, float, float, float, float]:
        """Return centre, radius around the solids and around the leaves, spread, and speed of a cluster.

        Inner joints are sampled over their range; between two samples a centre moves by at most its speed times half
        the spacing.
        """
        members = [k for k, c in enumerate(self.cluster_of) if c == cluster]
        dof = self._dof(cluster)
        values = np.zeros(1) if dof < 0 else np.linspace(self.lower[dof], self.upper[dof], SAMPLES)
        top = self.clusters[cluster][0]
        poses = {top: np.tile(np.eye(4), (len(values), 1, 1))}
        for k in self.lazy[cluster]:
            joint = self.joints[k]
            poses[k] = poses[joint.parent] @ self.placements[k] @ _motions(joint, values)
        points = np.concatenate([_transform(poses[self.bodies[m].joint], self.centres[m]) for m in members], axis=1)
        radii = np.concatenate([np.asarray(self.bodies[m].radii, float) for m in members])
        roots = np.concatenate([np.arange(len(self.bodies[m].radii)) == 0 for m in members])
        speeds = np.concatenate([self._speed(m, top) for m in members])
        slack = 0.0 if dof < 0 else speeds * (self.upper[dof] - self.lower[dof]) / (SAMPLES - 1) / 2.0
        centre = _middle(points[:, roots], (radii + slack)[roots])
        away = np.linalg.norm(points - centre, axis=2).max(axis=0) + slack
        leaves = np.concatenate([outer[m] for m in members])
        # The roots contain the solids; the leaves and inner nodes are what moves.
        return (
            centre, float((away + radii)[roots].max()) + 1e-9, float((away + leaves)[roots].max()) + 1e-9,
            float(away.max()) + 1e-9, float(speeds.max()),
        )  # fmt: skip

    def _speed(self, body: int, top: int) -> Array:
        """Bound the speed of a body's spheres relative to the cluster's joint, per unit of the planned joint."""
        reach = np.linalg.norm(self.centres[body], axis=1)
        speed = np.zeros(len(reach))
        k = self.bodies[body].joint
        while k != top:
            joint = self.joints[k]
            if joint.kind == REVOLUTE:
                speed += abs(joint.ratio) * reach
            elif joint.kind == PRISMATIC:
                speed += abs(joint.ratio)
                widest = max(abs(joint.ratio * v + joint.shift) for v in self._range(joint.source))
                reach = reach + widest
            reach = reach + np.linalg.norm(self.placements[k][:3, 3])
            k = joint.parent
        return speed

    def _range(self, dof: int) -> tuple[float, float]:
        return float(self.lower[dof]), float(self.upper[dof])


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


def _outer(centres: Array, radii: Array, body: BodySpec) -> Array:
    """Return for each node a radius around all leaves below it."""
    above = np.full(len(radii), -1)
    for k in np.flatnonzero(body.count):
        above[body.first[k] : body.first[k] + body.count[k]] = k
    leaves = np.flatnonzero(np.asarray(body.count) == 0)
    outer, at = np.zeros(len(radii)), leaves
    while len(leaves):
        np.maximum.at(outer, at, np.linalg.norm(centres[leaves] - centres[at], axis=1) + radii[leaves])
        at = above[at]
        leaves, at = leaves[at >= 0], at[at >= 0]
    return outer + 1e-12


def _middle(points: Array, radii: Array) -> Array:
    """Return about the centre of the smallest ball around balls: points (..., n, 3), radii (n,).

    By steps towards the farthest (Badoiu and Clarkson 2003).
    """
    flat = points.reshape(-1, 3)
    wide = np.broadcast_to(radii, points.shape[:-1]).ravel()
    centre: Array = flat.mean(axis=0)
    for step in range(1, 100):
        offsets = flat - centre
        k = int(np.argmax(np.linalg.norm(offsets, axis=1) + wide))
        long = float(np.linalg.norm(offsets[k]))
        if long == 0.0:
            break
        centre = centre + offsets[k] / long * (long + wide[k]) / (step + 1) * 0.5
    return centre


def _transform(pose: Array, points: Array) -> Array:
    return points @ np.swapaxes(pose[..., :3, :3], -1, -2) + pose[..., None, :3, 3]


def _ints(values: object) -> NDArray[np.int64]:
    return np.array(values, np.int64)


def _spans(counts: Sequence[int]) -> NDArray[np.int64]:
    first = np.cumsum([0, *counts])[:-1]
    return np.stack([first, np.array(counts, int)], axis=1).astype(np.int64).reshape(-1, 2)
