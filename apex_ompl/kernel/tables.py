"""The robot and the scene as flat arrays: all that the kernel knows, without Pinocchio.

A robot is a tree of joints; bodies hang on joints and are covered by trees of spheres (:mod:`apex_ompl.collision`
makes and proves them). Bodies that move together, or nearly so (a hand with its fingers), form a cluster inside one
ball, which is what is looked at first. Every joint frame is turned so that its axis is z.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.schema import is_file, write_atomically

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

SCHEMA = "apex-ompl/kernel-tables/1"
FIXED, REVOLUTE, PRISMATIC = 0, 1, 2


class RobotArrays(NamedTuple):
    """Arrays of a robot; J joints (0 is the world), C clusters, B bodies, N spheres, P pairs of clusters.

    Joints come after their parents. ``joint_rotation`` and ``joint_offset`` place a joint in its parent; its value is
    ``joint_ratio * q[joint_source] + joint_shift`` (mimic joints share a source), about or along z.

    ``cluster_ball`` holds centre and radius of a ball around all of a cluster's solids in the frame of
    ``cluster_joint``, for all values of its inner joints, those that ``lazy`` lists; ``cluster_outer`` is the radius
    around its leaf spheres, ``cluster_spread`` the largest distance of a sphere's centre from the ball's,
    ``cluster_speed`` the largest speed of such a centre in that frame, per unit of ``q[cluster_dof]``.

    A node is a sphere (``node_centre`` in the frame of its body's joint, ``node_radius``) around the part of the solid
    that the leaves below answer for; ``node_outer`` is a radius around the leaves themselves.
    """

    joint_parent: Integers
    joint_kind: Integers
    joint_source: Integers
    eager: Integers
    lazy: Integers
    cluster_joint: Integers
    cluster_lazy: Integers
    cluster_dof: Integers
    cluster_bodies: Integers
    cluster_meets_scene: Integers
    body_joint: Integers
    body_root: Integers
    node_first: Integers
    node_count: Integers
    pair_clusters: Integers
    pair_common: Integers
    pair_bodies: Integers
    bodies: Integers
    joint_rotation: Floats
    joint_offset: Floats
    joint_ratio: Floats
    joint_shift: Floats
    lower: Floats
    upper: Floats
    cluster_ball: Floats
    cluster_outer: Floats
    cluster_spread: Floats
    cluster_speed: Floats
    node_centre: Floats
    node_radius: Floats
    node_outer: Floats


class SceneArrays(NamedTuple):
    """Arrays of a scene; O obstacles, sorted so that each leaf of a tree of boxes holds a range of them.

    ``kind`` is one of BOX ... HALF_SPACE, ``owner`` the number of the obstacle it stands for. ``size`` holds half
    edges, or radius and half length; a half-space has its unit normal in ``offset`` and its distance in ``size``.
    ``ball`` is a radius around the obstacle's origin. Nodes of the tree are in depth-first order, ``tree_skip`` is
    the next node when one is left out, ``tree_range`` first obstacle and number of them (0 for inner nodes). The
    last ``open`` obstacles are half-spaces, which no box holds.
    """

    kind: Integers
    owner: Integers
    tree_skip: Integers
    tree_range: Integers
    open: Integers
    rotation: Floats
    offset: Floats
    size: Floats
    ball: Floats
    tree_low: Floats
    tree_high: Floats


BOX, SPHERE, CYLINDER, CAPSULE, HALF_SPACE = range(5)

ROWS = {
    "cluster_lazy": (2,), "cluster_bodies": (2,), "pair_clusters": (2,), "pair_bodies": (2,), "bodies": (2,),
    "joint_rotation": (3, 3), "joint_offset": (3,), "cluster_ball": (4,), "node_centre": (3,),
    "tree_range": (2,), "rotation": (3, 3), "offset": (3,), "size": (3,), "tree_low": (3,), "tree_high": (3,),
}  # fmt: skip
"""Shape of one row of the arrays whose rows are not single numbers."""

WHOLE = RobotArrays._fields[: RobotArrays._fields.index("joint_rotation")]  # integers come first


def pack(arrays: RobotArrays | SceneArrays) -> tuple[Integers, Floats]:
    """Return all arrays behind each other in two, which the kernel takes apart again.

    Passing two arrays to compiled code costs a tenth of passing thirty. The first holds, for every field in order,
    where its numbers begin and end, and then the numbers of the integer fields.
    """
    where: list[int] = []
    parts: dict[str, list[NDArray[Any]]] = {"i": [], "f": []}
    ends = {"i": 2 * len(arrays), "f": 0}
    for array in arrays:
        kind = "i" if array.dtype == np.int64 else "f"
        where += [ends[kind], ends[kind] + array.size]
        ends[kind] += array.size
        parts[kind].append(array.ravel())
    return np.concatenate([np.array(where, np.int64), *parts["i"]]), np.concatenate(parts["f"])


@dataclass(frozen=True, eq=False)
class RobotTables:
    """A robot as the kernel knows it.

    Attributes:
        name: Name of the robot.
        joint_names: Planned joints in state order.
        body_names: Names of the bodies.
        numbers: What the bodies go by outside of the tables.
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

    packed: tuple[Integers, Floats] = (np.empty(0, np.int64), np.empty(0))

    @property
    def dof(self) -> int:
        """Number of planned joints."""
        return len(self.joint_names)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the tables as a NumPy ``.npz`` file, under a temporary name first.

        Raises:
            MissingFileError: The folder is missing or cannot be written.
        """
        head: dict[str, object] = {
            "schema": SCHEMA,
            "name": self.name,
            "joints": self.joint_names,
            "bodies": self.body_names,
        }
        head["numbers"] = self.numbers
        stream = io.BytesIO()
        np.savez_compressed(stream, about=np.array(json.dumps(head)), **self.arrays._asdict())
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
                arrays = {name: data[name] for name in RobotArrays._fields}
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise FileFormatError(str(path), "", type(error).__name__, "expected kernel tables (.npz)") from error
        if not isinstance(head, dict) or head.get("schema") != SCHEMA:
            found = head.get("schema") if isinstance(head, dict) else head
            raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")
        for name, array in arrays.items():
            wanted = np.int64 if name in WHOLE else np.float64
            if array.dtype != wanted or array.shape[1:] != ROWS.get(name, ()):
                expected = f"expected {np.dtype(wanted)} in rows of shape {ROWS.get(name, ())}"
                raise FileFormatError(str(path), name, f"{array.dtype} {array.shape}", expected)
        fault = inconsistency(RobotArrays(**arrays), len(head["joints"]), len(head["bodies"]))
        if fault:
            raise FileFormatError(str(path), fault, "numbers out of range", "expected tables that fit each other")
        names = (tuple(head["joints"]), tuple(head["bodies"]), tuple(head["numbers"]))
        return cls(head["name"], *names, RobotArrays(**arrays))


def inconsistency(arrays: RobotArrays, dof: int, bodies: int) -> str:
    """Return the name of a field whose numbers point outside of the tables, or whose length is wrong; else nothing."""
    sizes = {"joint": len(arrays.joint_parent), "cluster": len(arrays.cluster_joint), "body": bodies}
    sizes |= {"node": len(arrays.node_first), "pair": len(arrays.pair_common)}
    for name, array in arrays._asdict().items():
        room = name.split("_")[0]
        if room in sizes and len(array) != sizes[room]:
            return name
        if array.dtype == np.float64 and not np.isfinite(array).all():
            return name
    ranges = {
        "joint_parent": sizes["joint"], "eager": sizes["joint"], "lazy": sizes["joint"], "body_root": sizes["node"],
        "cluster_joint": sizes["joint"], "body_joint": sizes["joint"], "pair_clusters": sizes["cluster"],
        "pair_common": sizes["joint"], "bodies": bodies, "joint_kind": 3,
    }  # fmt: skip
    for name, size in ranges.items():
        array = getattr(arrays, name)
        if array.size and not 0 <= array.min() <= array.max() < size:
            return name
    for name in ("joint_source", "cluster_dof"):
        array = getattr(arrays, name)
        if array.size and not -1 <= array.min() <= array.max() < dof:
            return name
    spans = {"cluster_lazy": len(arrays.lazy), "cluster_bodies": bodies, "pair_bodies": len(arrays.bodies)}
    for name, size in spans.items():
        array = getattr(arrays, name)
        if array.size and (array.min() < 0 or array.sum(axis=1).max() > size):
            return name
    below = arrays.node_count > 0
    last = arrays.node_first + arrays.node_count
    forward = arrays.node_first[below] > np.flatnonzero(below)
    if not forward.all() or (last[below] > sizes["node"]).any():
        return "node_first"
    if (arrays.joint_parent[1:] >= np.arange(1, sizes["joint"])).any():
        return "joint_parent"
    return "" if len(arrays.lower) == len(arrays.upper) == dof else "lower"


@dataclass(frozen=True, eq=False)
class SceneTables:
    """Obstacles as the kernel knows them.

    Attributes:
        arrays: The arrays.
        packed: The same as :func:`pack` returns them.
    """

    arrays: SceneArrays

    def __post_init__(self) -> None:
        """Pack the arrays."""
        object.__setattr__(self, "packed", pack(self.arrays))

    packed: tuple[Integers, Floats] = (np.empty(0, np.int64), np.empty(0))


class Primitive(NamedTuple):
    """A solid that the kernel has a shape for.

    Attributes:
        kind: BOX, SPHERE, CYLINDER, CAPSULE or HALF_SPACE.
        pose: Homogeneous transform in the world, shape (4, 4) [m]; that of a half-space is not looked at.
        size: Half edges of a box; radius and half length along z; radius; or (unit normal, distance) of a half-space,
            the points x with normal . x <= distance [m].
    """

    kind: int
    pose: Floats
    size: tuple[float, ...]


LEAF = 4  # obstacles in a leaf of the tree


def scene_tables(solids: Sequence[tuple[int, Primitive]]) -> SceneTables:
    """Return the arrays of obstacles, each with the number of what it stands for.

    The tree of boxes is split at the median along its longest side (a standard bounding volume hierarchy).
    """
    closed = [(o, p) for o, p in solids if p.kind != HALF_SPACE]
    open_ = [(o, p) for o, p in solids if p.kind == HALF_SPACE]
    boxes = np.array([_box(p) for _, p in closed]).reshape(-1, 2, 3)
    order: list[int] = []
    tree: list[tuple[Floats, int, int, int]] = []  # box, skip, first, count

    def grow(members: NDArray[np.intp]) -> None:
        at = len(tree)
        box = np.stack([boxes[members, 0].min(axis=0), boxes[members, 1].max(axis=0)])
        tree.append((box, 0, len(order), 0))
        if len(members) <= LEAF:
            order.extend(int(k) for k in members)
            tree[at] = (box, len(tree), len(order) - len(members), len(members))
            return
        middle = boxes[members].mean(axis=1)
        ranked = members[np.argsort(middle[:, int(np.argmax(np.ptp(middle, axis=0)))], kind="stable")]
        grow(ranked[: len(ranked) // 2])
        grow(ranked[len(ranked) // 2 :])
        tree[at] = (box, len(tree), 0, 0)

    if closed:
        grow(np.arange(len(closed)))
    chosen = [closed[k] for k in order] + open_
    rows = [_row(p) for _, p in chosen]
    bounds = np.array([node[0] for node in tree]).reshape(-1, 2, 3)
    arrays = SceneArrays(
        kind=np.array([p.kind for _, p in chosen], np.int64),
        owner=np.array([o for o, _ in chosen], np.int64),
        tree_skip=np.array([node[1] for node in tree], np.int64),
        tree_range=np.array([node[2:] for node in tree], np.int64).reshape(-1, 2),
        open=np.array([len(open_)], np.int64),
        rotation=np.array([r[0] for r in rows]).reshape(-1, 3, 3),
        offset=np.array([r[1] for r in rows]).reshape(-1, 3),
        size=np.array([r[2] for r in rows]).reshape(-1, 3),
        ball=np.array([r[3] for r in rows], float),
        tree_low=np.ascontiguousarray(bounds[:, 0]),
        tree_high=np.ascontiguousarray(bounds[:, 1]),
    )
    return SceneTables(arrays)


def _row(p: Primitive) -> tuple[Floats, Floats, Floats, float]:
    if p.kind == HALF_SPACE:
        return np.eye(3), np.array(p.size[:3]), np.array([p.size[3], 0.0, 0.0]), np.inf
    size = np.zeros(3)
    size[: len(p.size)] = p.size
    ball = {BOX: float(np.linalg.norm(size)), SPHERE: size[0], CYLINDER: float(np.hypot(*size[:2]))}
    return p.pose[:3, :3], p.pose[:3, 3], size, float(ball.get(p.kind, size[0] + size[1]))


def _box(p: Primitive) -> Floats:
    """Return the axis-aligned box around a solid, shape (2, 3)."""
    turn, middle, size, _ = _row(p)
    if p.kind == BOX:
        half = np.abs(turn) @ size
    elif p.kind == SPHERE:
        half = np.full(3, size[0])
    elif p.kind == CAPSULE:
        half = np.abs(turn[:, 2]) * size[1] + size[0]
    else:
        half = np.abs(turn[:, 2]) * size[1] + size[0] * np.sqrt(np.maximum(0.0, 1.0 - turn[:, 2] ** 2))
    half = half + 1e-9  # rounding
    return np.stack([middle - half, middle + half])
