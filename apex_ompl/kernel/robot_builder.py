"""Tables of a robot from its joints, covered bodies and pairs of bodies."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.clearance_table import ClearanceTable, table_arrays
from apex_ompl.kernel.compiled.arrays import BINS, FIXED, LIMIT_SLACK, RobotArrays
from apex_ompl.kernel.joint_tree import ClusterBall, JointTree, Member
from apex_ompl.kernel.tables import BodySpec, RobotTables, pair_runs
from apex_ompl.types import Array, Flags


class PairRow(NamedTuple):
    """Two clusters whose bodies are checked against each other.

    Attributes:
        clusters: Their numbers.
        common: Their lowest common joint.
        bodies: The rows of the pairs of their bodies, shape (n, 2).
    """

    clusters: tuple[int, int]
    common: int
    bodies: NDArray[np.int64]


def robot_tables(
    name: str,
    joint_names: Sequence[str],
    *,
    lower: Array,
    upper: Array,
    tree: JointTree,
    bodies: Sequence[BodySpec],
    pairs: Sequence[tuple[int, int]],
    numbers: Sequence[int] | None = None,
    clearances: Mapping[tuple[int, int], ClearanceTable] | None = None,
    weights: Array | None = None,
    continuous: Flags | None = None,
) -> RobotTables:
    """Return the tables of a robot.

    Args:
        name: Name of the robot.
        joint_names: Planned joints in state order.
        lower: Their lowest values, shape (dof,).
        upper: Their highest values, shape (dof,).
        tree: Its joints.
        bodies: The solids.
        pairs: Places of the bodies that are checked against each other.
        numbers: Numbers of the bodies outside of the tables; by default their places.
        clearances: Tables of clearances of some of the pairs.
        weights: What a unit of each planned joint counts in distances, shape (dof,); 1 by default [rad/rad, rad/m].
        continuous: Which planned joints turn without end, shape (dof,); none by default.
    """
    given = range(len(bodies)) if numbers is None else numbers
    dof = len(joint_names)
    weights = np.ones(dof) if weights is None else np.array(weights, float)
    continuous = np.zeros(dof, bool) if continuous is None else continuous
    builder = _Builder(tree, bodies, lower, upper, weights, continuous)
    return builder.tables(name, tuple(joint_names), pairs, given, clearances or {})


class _Builder:
    """A tree of joints, and bodies sorted by cluster."""

    def __init__(
        self, tree: JointTree, bodies: Sequence[BodySpec], lower: Array, upper: Array, weights: Array, continuous: Flags
    ) -> None:
        self.tree, self.lower, self.upper, self.weights, self.continuous = tree, lower, upper, weights, continuous
        keys = [self._key(b, k) for k, b in enumerate(bodies)]
        self.clusters = sorted(set(keys))
        branches = [tree.branch(b.joint, tree.home[b.joint]) for b in bodies]
        numbers = {key: k for k, key in enumerate(self.clusters)}
        places = [numbers[key] for key in keys]
        order = sorted(range(len(bodies)), key=lambda b: (places[b], branches[b], b))
        self.number = {b: k for k, b in enumerate(order)}  # body as given -> row
        self.bodies = [bodies[b] for b in order]
        self.cluster_of = [places[b] for b in order]
        self.rows_of: list[list[int]] = [[] for _ in self.clusters]
        for row, cluster in enumerate(self.cluster_of):
            self.rows_of[cluster].append(row)
        placed = [tree.placed(body) for body in self.bodies]
        self.centers = [one.centers for one in placed]
        self.outer = [one.outer for one in placed]
        self.inner = [one.inner for one in placed]
        self.lazy = [tree.inner(top) for top, _ in self.clusters]
        self.branches = [
            [tree.branch(k, top) for k in ks] for (top, _), ks in zip(self.clusters, self.lazy, strict=True)
        ]
        self.part_of = [(places[b], branches[b]) for b in order]  # cluster and branch of each body
        self.parts = list(dict.fromkeys(self.part_of))
        seen = Counter[int]()
        self.bit_of = dict[tuple[int, int], int]()  # of each part among those of its cluster
        for part in self.parts:
            self.bit_of[part] = 1 << seen[part[0]]
            seen[part[0]] += 1
        self.driver = [self._dof(cluster) for cluster in range(len(self.clusters))]

    def _key(self, body: BodySpec, number: int) -> tuple[int, int]:
        """Return the key of a body's cluster: the joint, and whether it meets the scene; each fixed body is its own."""
        home = self.tree.home[body.joint]
        return (home, number if home == 0 else int(body.meets_scene))

    def tables(
        self, name: str, joint_names: tuple[str, ...], pairs: Sequence[tuple[int, int]], numbers: Sequence[int],
        clearances: Mapping[tuple[int, int], ClearanceTable],
    ) -> RobotTables:  # fmt: skip
        joints, bodies = self.tree.joints, self.bodies
        rows = sorted(self.number, key=lambda b: self.number[b])
        inner = {k for ks in self.lazy for k in ks}
        trees = [np.asarray(b.radii, float) for b in bodies]
        starts = np.cumsum([0, *(len(t) for t in trees)])
        outer = self.outer
        balls = [self._ball(c, outer) for c in range(len(self.clusters))]
        pair_rows = self._pairs(pairs)
        pair_balls = self._pair_balls(pair_rows, balls, outer)
        parts = [self._part_balls(*part, outer) for part in self.parts]
        tables = {tuple(sorted(self.number[b] for b in pair)): table for pair, table in clearances.items()}
        body_rows = np.concatenate([np.empty((0, 2), np.int64), *(pair.bodies for pair in pair_rows)])
        pair_clusters = _ints([pair.clusters for pair in pair_rows]).reshape(-1, 2)
        arrays = RobotArrays(
            joint_parent=_ints([j.parent for j in joints]),
            joint_kind=_ints([j.kind for j in joints]),
            joint_source=_ints([j.source if j.kind != FIXED else -1 for j in joints]),
            eager=_ints([k for k in range(1, len(joints)) if k not in inner]),
            lazy=_ints([k for ks in self.lazy for k in ks]),
            cluster_joint=_ints([j for j, _ in self.clusters]),
            cluster_lazy=_spans([len(ks) for ks in self.lazy]),
            cluster_dof=_ints(self.driver),
            cluster_bodies=_spans([len(rows) for rows in self.rows_of]),
            cluster_meets_scene=_ints([bodies[rows[0]].meets_scene for rows in self.rows_of]),
            cluster_parts=_spans(np.bincount([c for c, _ in self.parts], minlength=len(self.clusters)).tolist()),
            part_lazy=_ints([self._part_joints(*part) for part in self.parts]).reshape(-1, 2),
            part_bodies=_spans(list(Counter(self.part_of).values())),
            body_joint=_ints([b.joint for b in bodies]),
            body_root=_ints(starts[:-1]),
            node_first=_joined([np.asarray(b.first, np.int64) + k for b, k in zip(bodies, starts, strict=False)]),
            node_count=_joined([np.asarray(b.count, np.int64) for b in bodies]),
            pair_clusters=pair_clusters,
            pair_common=_ints([pair.common for pair in pair_rows]),
            pair_bodies=_spans([len(pair.bodies) for pair in pair_rows]),
            bodies=body_rows,
            joint_rotation=np.array([p[:3, :3] for p in self.tree.placements]),
            joint_offset=np.array([p[:3, 3] for p in self.tree.placements]),
            joint_ratio=np.array([j.ratio for j in joints], float),
            joint_shift=np.array([j.shift for j in joints], float),
            lower=np.array(self.lower, float),
            upper=np.array(self.upper, float),
            weight=self.weights,
            continuous=_ints(self.continuous),
            cluster_ball=np.array([[*ball.center, ball.radius] for ball in balls]).reshape(-1, 4),
            cluster_outer=np.array([ball.outer for ball in balls]),
            part_ball=np.array([ball for ball, _ in parts]).reshape(-1, BINS, 4),
            part_outer=np.array([leaves for _, leaves in parts]).reshape(-1, BINS),
            cluster_spread=np.array([ball.spread for ball in balls]),
            cluster_speed=np.array([ball.speed for ball in balls]),
            cluster_range=np.array([self._range(c) for c in range(len(balls))]).reshape(-1, 2),
            node_center=np.concatenate([np.empty((0, 3)), *self.centers]),
            node_radius=np.concatenate([np.empty(0), *trees]),
            node_outer=np.concatenate([np.empty(0), *outer]),
            body_inner=_spans([len(balls) for balls in self.inner]),
            inner_ball=np.concatenate([np.empty((0, 4)), *self.inner]),
            pair_ball=np.array([[[*b.center, b.radius] for b in two] for two in pair_balls]).reshape(-1, 2, 4),
            pair_outer=np.array([[b.outer for b in two] for two in pair_balls]).reshape(-1, 2),
            pair_parts=self._pair_parts(pair_rows),
            run_pairs=pair_runs(pair_clusters),
            **table_arrays([tables.get((a, b)) for a, b in body_rows.tolist()], joint_names),
        )
        return RobotTables(name, joint_names, tuple(b.name for b in bodies), tuple(numbers[b] for b in rows), arrays)

    def _dof(self, cluster: int) -> int:
        joints = (self.tree.joints[k] for k in self.lazy[cluster])
        sources = [joint.source for joint in joints if joint.kind != FIXED]
        return sources[0] if sources else -1

    def _range(self, cluster: int) -> tuple[float, float]:
        """Return the lowest value of the joint that drives a cluster's inner ones, and ranges of values per unit."""
        dof = self.driver[cluster]
        low, high = (0.0, 0.0) if dof < 0 else (float(self.lower[dof]), float(self.upper[dof]))
        return low, BINS / (high - low) if high > low else 0.0

    def _pairs(self, pairs: Sequence[tuple[int, int]]) -> list[PairRow]:
        """Return pairs of clusters, by their numbers."""
        if not len(pairs):
            return []
        row_of = np.empty(len(self.number), np.int64)
        row_of[list(self.number)] = list(self.number.values())
        rows = np.sort(row_of[np.array(pairs, np.int64)], axis=1)
        clusters = np.array(self.cluster_of, np.int64)[rows]
        order = np.lexsort((rows[:, 1], rows[:, 0], clusters[:, 1], clusters[:, 0]))
        rows, clusters = rows[order], clusters[order]
        starts = np.flatnonzero(np.r_[True, (np.diff(clusters, axis=0) != 0).any(axis=1)])
        found = []
        for (c, d), members in zip(clusters[starts].tolist(), np.split(rows, starts[1:]), strict=True):
            above = set(self.tree.chains[self.clusters[d][0]])
            common = next(k for k in self.tree.chains[self.clusters[c][0]] if k in above)
            found.append(PairRow((c, d), common, members))
        return found

    def _pair_balls(
        self, pairs: Sequence[PairRow], balls: Sequence[ClusterBall], outer: Sequence[Array]
    ) -> list[list[ClusterBall]]:
        """Return for each pair of clusters balls around the bodies that it is about, of rigid clusters their own."""
        known: dict[frozenset[int], ClusterBall] = {}

        def around(cluster: int, rows: NDArray[np.int64]) -> ClusterBall:
            if not self.lazy[cluster]:
                return balls[cluster]
            some = frozenset(rows.tolist())
            if len(some) == len(self.rows_of[cluster]):
                return balls[cluster]
            if some not in known:
                known[some] = self._ball(cluster, outer, some)
            return known[some]

        return [[around(cluster, rows) for cluster, rows in zip(p.clusters, p.bodies.T, strict=True)] for p in pairs]

    def _pair_parts(self, pairs: Sequence[PairRow]) -> NDArray[np.int64]:
        """Return the bits of the parts of two clusters that each pair is about, shape (n, 2)."""
        bits = _ints([self.bit_of[part] for part in self.part_of])
        return _ints([np.bitwise_or.reduce(bits[pair.bodies], axis=0) for pair in pairs]).reshape(-1, 2)

    def _part_joints(self, cluster: int, branch: int) -> tuple[int, int]:
        """Return the first of a part's joints among the lazy ones, and their number."""
        before, of = sum(len(ks) for ks in self.lazy[:cluster]), self.branches[cluster]
        return (before + of.index(branch), of.count(branch)) if branch in of else (before, 0)

    def _part_balls(self, cluster: int, branch: int, outer: Sequence[Array]) -> tuple[Array, Array]:
        """Return the balls around a part."""
        some = frozenset(k for k, part in enumerate(self.part_of) if part == (cluster, branch))
        dof = self.driver[cluster]
        limits = None if dof < 0 else (float(self.lower[dof]), float(self.upper[dof]))
        joints = [k for k, of in zip(self.lazy[cluster], self.branches[cluster], strict=True) if of == branch]
        return self.tree.part_balls(self._members(cluster, outer, some), self.clusters[cluster][0], joints, limits)

    def _members(self, cluster: int, outer: Sequence[Array], some: frozenset[int] | None) -> list[Member]:
        """Return the bodies of a cluster, or some of them."""
        return [
            Member(self.bodies[k].joint, self.centers[k], np.asarray(self.bodies[k].radii, float), outer[k])
            for k in self.rows_of[cluster]
            if some is None or k in some
        ]

    def _ball(self, cluster: int, outer: Sequence[Array], some: frozenset[int] | None = None) -> ClusterBall:
        """Return the ball around a cluster, or some bodies of it."""
        members, dof = self._members(cluster, outer, some), self.driver[cluster]
        limits = None if dof < 0 else (float(self.lower[dof]) - LIMIT_SLACK, float(self.upper[dof]) + LIMIT_SLACK)
        return self.tree.ball(members, self.clusters[cluster][0], self.lazy[cluster], limits)


def _ints(values: object) -> NDArray[np.int64]:
    return np.array(values, np.int64)


def _joined(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate([np.empty(0, np.int64), *parts])


def _spans(counts: Sequence[int]) -> NDArray[np.int64]:
    first = np.cumsum([0, *counts])[:-1]
    return np.stack([first, np.array(counts, int)], axis=1).astype(np.int64).reshape(-1, 2)
