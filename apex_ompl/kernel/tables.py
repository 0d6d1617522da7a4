"""Tables of a robot and of a scene: their flat arrays with names, as files, and cut to some joints or pairs.

Joints and covered bodies, by their specifications, are the input of a robot's tables. What is read from files is
checked here: compiled code trusts its arrays.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError, UnknownNameError
from apex_ompl.kernel.compiled.arrays import BINS, BOX, FIXED, HALF_SPACE, PRISMATIC, RUN, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.layout import Floats, Integers, layout, pack
from apex_ompl.kernel.distance_grid import DistanceGrid
from apex_ompl.types import Array, Flags
from apex_ompl.util.files import is_file, write_atomically
from apex_ompl.util.validation import check_indices

PARTS = ("cluster_parts", "cluster_range", "part_lazy", "part_bodies", "part_ball", "part_outer")
CLEARANCES = ("bodies_table", "table_joints", "table_cells", "table_range", "table_bytes")
MADE = {"body_inner", "inner_ball", "pair_ball", "pair_outer", "pair_parts", "run_pairs", *PARTS, *CLEARANCES}
"""Arrays of a robot that make checks faster; they are not stored."""


def head_fault(head: dict[str, Any]) -> str:
    """Return the key of a file's head that is missing or of another type, or an empty string."""
    for key, kind in (("joints", str), ("bodies", str), ("numbers", int)):
        values = head.get(key)
        if not isinstance(values, list) or not all(type(v) is kind for v in values):
            return key
    return "" if isinstance(head.get("name"), str) else "name"


def scene_fault(s: SceneArrays) -> str:
    """Return the name of an array with another type or length, or with numbers out of range; else an empty string."""
    obstacles, boxes = len(s.kind), len(s.tree_skip)
    for part in layout(SceneArrays):
        name, array = part.name, getattr(s, part.name)
        if part.single:
            continue
        if array.dtype != part.dtype or array.shape[1:] != part.shape:
            return name
        size = boxes if name.startswith("tree") else {"open": 1, "allowed": len(s.allowed)}.get(name, obstacles)
        if len(array) != size or not np.isfinite(array).all():
            return name
    if obstacles and not BOX <= s.kind.min() <= s.kind.max() <= HALF_SPACE:
        return "kind"
    closed = obstacles - int(s.open[0])
    if not 0 <= closed <= obstacles or (s.kind[:closed] == HALF_SPACE).any() or (s.kind[closed:] != HALF_SPACE).any():
        return "open"
    if ((s.tree_skip <= np.arange(boxes)) | (s.tree_skip > boxes)).any():
        return "tree_skip"
    first, count = s.tree_range.T
    if boxes and not ((first >= 0) & (count >= 0) & (first <= closed) & (count <= closed - first)).all():
        return "tree_range"
    return ""


def robot_fault(t: RobotArrays, dof: int, bodies: int) -> str:
    """Return the name of an array with a wrong length, or with numbers out of range; else an empty string."""
    return _length_fault(t, dof, bodies) or _range_fault(t, dof, bodies) or _tree_fault(t) or _order_fault(t)


def _length_fault(t: RobotArrays, dof: int, bodies: int) -> str:
    sizes = {"joint": len(t.joint_parent), "cluster": len(t.cluster_joint), "body": bodies}
    sizes |= {"node": len(t.node_first), "pair": len(t.pair_common), "lower": dof, "upper": dof}
    sizes |= {"weight": dof, "continuous": dof}
    if sizes["joint"] == 0:
        return "joint_parent"
    for name, array in ((name, array) for name, array in t._asdict().items() if name not in MADE):
        if len(array) != sizes.get(name.split("_")[0], len(array)):
            return name
        if array.dtype == np.float64 and not np.isfinite(array).all():
            return name
    return ""


def _range_fault(t: RobotArrays, dof: int, bodies: int) -> str:
    joints, clusters, nodes = len(t.joint_parent), len(t.cluster_joint), len(t.node_first)
    ranges = {
        "joint_parent": (0, joints), "eager": (1, joints), "lazy": (1, joints), "body_root": (0, nodes),
        "cluster_joint": (0, joints), "body_joint": (0, joints), "pair_clusters": (0, clusters),
        "pair_common": (0, joints), "bodies": (0, bodies), "joint_kind": (FIXED, PRISMATIC + 1),
        "continuous": (0, 2),
        "joint_source": (-1, dof), "cluster_dof": (-1, dof), "cluster_lazy": (0, len(t.lazy) + 1),
        "cluster_bodies": (0, bodies + 1), "pair_bodies": (0, len(t.bodies) + 1), "node_count": (0, nodes),
    }  # fmt: skip
    for name, (low, high) in ranges.items():
        array = getattr(t, name)
        if array.size and not low <= array.min() <= array.max() < high:
            return name
    for name, most in (("eager", len(t.eager)), ("cluster_lazy", t.cluster_lazy[:, 1].max(initial=0))):
        if most >= joints:
            return name
    for name, size in (("cluster_lazy", len(t.lazy)), ("cluster_bodies", bodies), ("pair_bodies", len(t.bodies))):
        array = getattr(t, name)
        if array.size and array.sum(axis=1).max() > size:
            return name
    if (t.joint_source[t.joint_kind != FIXED] < 0).any():
        return "joint_source"
    if not (t.weight > 0.0).all():
        return "weight"
    for name in ("node_radius", "node_outer", "cluster_outer", "cluster_spread", "cluster_speed"):
        if (getattr(t, name) < 0.0).any():
            return name
    return "cluster_ball" if (t.cluster_ball[:, 3] < 0.0).any() else ""


def _tree_fault(t: RobotArrays) -> str:
    """Bodies must have nodes of their own, and children must follow their parents inside a body."""
    ends = np.append(t.body_root[1:], len(t.node_first))
    if len(t.body_root) and (t.body_root[0] != 0 or (ends <= t.body_root).any()):
        return "body_root"
    body = np.repeat(np.arange(len(t.body_root)), ends - t.body_root)
    inner = np.flatnonzero(t.node_count)
    first, last = t.node_first[inner], t.node_first[inner] + t.node_count[inner]
    if (first <= inner).any() or (last > ends[body[inner]]).any():
        return "node_first"
    if (t.bodies[:, 0] == t.bodies[:, 1]).any():
        return "bodies"
    return "joint_parent" if (t.joint_parent[1:] >= np.arange(1, len(t.joint_parent))).any() else ""


def _order_fault(t: RobotArrays) -> str:
    """Every joint must be placed after its parent, for each cluster, and pairs must name a joint above both."""
    placed = {0}
    for j in t.eager.tolist():
        if int(t.joint_parent[j]) not in placed:
            return "eager"
        placed.add(j)
    for c, top in enumerate(t.cluster_joint.tolist()):
        here = set(placed)
        first, count = t.cluster_lazy[c].tolist()
        for j in t.lazy[first : first + count].tolist():
            if int(t.joint_parent[j]) not in here:
                return "lazy"
            here.add(j)
        first, count = t.cluster_bodies[c].tolist()
        if top not in placed or not set(t.body_joint[first : first + count].tolist()) <= here:
            return "cluster_joint"
    for (a, b), common in zip(t.pair_clusters.tolist(), t.pair_common.tolist(), strict=True):
        if not all(common in _above(t, int(t.cluster_joint[c])) for c in (a, b)):
            return "pair_common"
    return ""


def _above(t: RobotArrays, joint: int) -> set[int]:
    chain = {0, joint}
    while joint > 0:
        joint = int(t.joint_parent[joint])
        chain.add(joint)
    return chain


SCHEMA = "apex-ompl/kernel-tables/1"
PAIRS = ("pair_clusters", "pair_common", "pair_bodies", "pair_ball", "pair_outer", "pair_parts")
STORED = tuple(name for name in RobotArrays._fields if name not in MADE)


def no_balls() -> Array:
    """Return no balls, shape (0, 4)."""
    return np.empty((0, 4))


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
        centers: Shape (n, 3) [m]; node 0 is the root.
        radii: Shape (n,) [m].
        first: First child of each node, shape (n,).
        count: Number of children of each node, 0 for leaves, shape (n,).
        inner: Centers and radii of balls inside of the solid, in the frame of the spheres, shape (k, 4) [m].
        meets_scene: Whether it is checked against obstacles.
    """

    name: str
    joint: int
    placement: Array
    centers: Array
    radii: Array
    first: NDArray[np.int64]
    count: NDArray[np.int64]
    inner: Array = field(default_factory=no_balls)
    meets_scene: bool = True


def pair_runs(pairs: Integers) -> Integers:
    """Return ``RobotArrays.run_pairs`` of pairs of clusters, shape (P, 2)."""
    runs: list[list[int]] = []
    for k, (a, b) in enumerate(pairs.tolist()):
        if runs and runs[-1][0] == a and runs[-1][1] + runs[-1][3] == b and runs[-1][3] < RUN:
            runs[-1][3] += 1
        else:
            runs.append([a, b, k, 1])
    return np.array(runs, np.int64).reshape(-1, 4)


def with_pairs(arrays: RobotArrays, chosen: Flags) -> RobotArrays:
    """Return arrays of a robot with some of its pairs of clusters, shape (P,), alone."""
    kept = {name: getattr(arrays, name)[chosen] for name in RobotArrays._fields if name in PAIRS}
    return arrays._replace(**kept, run_pairs=pair_runs(arrays.pair_clusters[chosen]))


@dataclass(frozen=True, eq=False)
class RobotTables:
    """A robot for the kernel.

    Attributes:
        name: Name of the robot.
        joint_names: Planned joints in state order.
        body_names: Names of the bodies.
        numbers: Numbers of the bodies outside of the tables.
        arrays: The arrays.
        packed: The same as :func:`pack` returns them.
    """

    name: str
    joint_names: tuple[str, ...]
    body_names: tuple[str, ...]
    numbers: tuple[int, ...]
    arrays: RobotArrays

    def __post_init__(self) -> None:
        """Pack the arrays."""
        object.__setattr__(self, "packed", pack(self.arrays))

    packed: tuple[Any, ...] = field(init=False)

    @property
    def dof(self) -> int:
        """Number of planned joints."""
        return len(self.joint_names)

    def restricted_to(self, joints: Sequence[int]) -> RobotTables:
        """Return tables that check only bodies which these planned joints move, and no other joints.

        With them arms can be placed one after the other, each against the scene, itself and what does not move.

        Args:
            joints: Numbers of planned joints.

        Raises:
            ParameterError: There is no such joint.
        """
        check_indices(joints, self.dof, "joints", "planned joints")
        a, mine = self.arrays, {int(k) for k in joints}
        dynamic: list[set[int]] = []  # of each joint; parents come first
        for parent, source in zip(a.joint_parent, a.joint_source, strict=True):
            above = dynamic[parent] if dynamic else set()
            dynamic.append(above | ({int(source)} - {-1}))
        inner = (set() if dof < 0 else {int(dof)} for dof in a.cluster_dof)
        clusters = [dynamic[j] | own for j, own in zip(a.cluster_joint, inner, strict=True)]
        meets = [bool(m) and bool(c) and c <= mine for m, c in zip(a.cluster_meets_scene, clusters, strict=True)]
        pairs = [bool(both) and both <= mine for both in (clusters[c] | clusters[d] for c, d in a.pair_clusters)]
        arrays = with_pairs(a, np.array(pairs, bool))._replace(cluster_meets_scene=np.array(meets, np.int64))
        return RobotTables(self.name, self.joint_names, self.body_names, self.numbers, arrays)

    def without_pair(self, first: str, second: str) -> RobotTables:
        """Return tables that do not check two bodies, given by name, against each other.

        Raises:
            UnknownNameError: No such body.
        """
        a = self.arrays
        for name in (first, second):
            if name not in self.body_names:
                raise UnknownNameError("body", name, self.body_names)
        both = {self.body_names.index(first), self.body_names.index(second)}
        kept = np.array([set(row) != both for row in a.bodies.tolist()], bool)
        before = np.concatenate([[0], np.cumsum(kept)])
        spans = np.array([(before[k], before[k + n] - before[k]) for k, n in a.pair_bodies], np.int64).reshape(-1, 2)
        arrays = a._replace(pair_bodies=spans, bodies=a.bodies[kept], bodies_table=a.bodies_table[kept])
        return RobotTables(self.name, self.joint_names, self.body_names, self.numbers, arrays)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the tables as a NumPy ``.npz`` file, under a temporary name first; MADE are left out.

        Raises:
            MissingFileError: The folder is missing or cannot be written.
        """
        head = {
            "schema": SCHEMA,
            "name": self.name,
            "joints": self.joint_names,
            "bodies": self.body_names,
            "numbers": self.numbers,
        }
        stream = io.BytesIO()
        stored = {name: getattr(self.arrays, name) for name in STORED}
        np.savez_compressed(stream, about=np.array(json.dumps(head)), **stored)
        write_atomically(Path(path), stream.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> RobotTables:
        """Read tables that :meth:`save` wrote; needs neither Pinocchio nor Coal.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: The file holds something else.
        """
        path = Path(path)
        if not is_file(path):
            raise MissingFileError(str(path), "file of kernel tables")
        try:
            with np.load(path, allow_pickle=False) as data:
                head = json.loads(str(data["about"]))
                arrays = {name: np.ascontiguousarray(data[name]) for name in STORED}
        except Exception as error:  # NumPy and zipfile let many kinds through
            raise FileFormatError(str(path), "", type(error).__name__, "expected kernel tables (.npz)") from error
        found = head.get("schema") if isinstance(head, dict) else head
        if found != SCHEMA:
            raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")
        columns = {column.name: column for column in layout(RobotArrays)}
        for column in (columns[name] for name in STORED):
            array = arrays[column.name]
            if array.dtype != column.dtype or array.shape[1:] != column.shape:
                expected = f"expected {np.dtype(column.dtype)} in rows of shape {column.shape}"
                raise FileFormatError(str(path), column.name, f"{array.dtype} {array.shape}", expected)
        none: dict[str, Any] = {name: np.empty((0, *columns[name].sized({})), columns[name].dtype) for name in MADE}
        fault = head_fault(head) or robot_fault(RobotArrays(**arrays, **none), len(head["joints"]), len(head["bodies"]))
        if not fault and len(head["numbers"]) != len(head["bodies"]):
            fault = "numbers"
        if fault:
            raise FileFormatError(str(path), fault, "values that do not fit", "expected tables that fit each other")
        joints, bodies, numbers = (tuple(head[key]) for key in ("joints", "bodies", "numbers"))
        return cls(head["name"], joints, bodies, numbers, RobotArrays(**arrays, **_as_whole(arrays)))


def _as_whole(stored: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the arrays MADE of stored ones, where each cluster is one part and nothing is known inside of bodies."""
    pairs, clusters = stored["pair_clusters"], np.arange(len(stored["cluster_joint"]))
    ball, outer = stored["cluster_ball"], stored["cluster_outer"]
    return {
        "body_inner": np.zeros((len(stored["body_joint"]), 2), np.int64), "inner_ball": np.empty((0, 4)),
        "pair_ball": ball[pairs], "pair_outer": outer[pairs], "pair_parts": np.ones_like(pairs),
        "run_pairs": pair_runs(pairs), "cluster_parts": np.stack([clusters, np.ones_like(clusters)], axis=1),
        "cluster_range": np.zeros((len(clusters), 2)), "part_lazy": stored["cluster_lazy"],
        "part_bodies": stored["cluster_bodies"], "part_ball": np.repeat(ball[:, None], BINS, axis=1),
        "part_outer": np.repeat(outer[:, None], BINS, axis=1),
        "bodies_table": np.full(len(stored["bodies"]), -1, np.int64), "table_joints": np.empty((0, 3), np.int64),
        "table_cells": np.empty((0, 2), np.int64), "table_range": np.empty((0, 3, 2)),
        "table_bytes": np.empty(0, np.int64),
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Obstacles for the kernel.

    Attributes:
        arrays: The arrays.
        boxes: Axis-aligned box around each solid, shape (n, 2, 3) [m]; empty unless obstacles may be moved.
        rank: Place of each solid among those of its obstacle, shape (n,); empty unless obstacles may be moved.
        grids: Grid of each solid, if it has one, n of them; empty unless obstacles may be moved.
        packed: The same as :func:`pack` returns them.
    """

    arrays: SceneArrays
    boxes: Floats = field(default_factory=lambda: np.empty((0, 2, 3)))
    rank: Integers = field(default_factory=lambda: np.empty(0, np.int64))
    grids: tuple[DistanceGrid | None, ...] = ()

    def __post_init__(self) -> None:
        """Pack the arrays."""
        object.__setattr__(self, "packed", pack(self.arrays))

    packed: tuple[Any, ...] = field(init=False)
