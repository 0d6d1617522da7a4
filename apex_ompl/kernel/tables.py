"""The robot and the scene as flat arrays: all that the kernel knows, without Pinocchio.

A robot is a tree of joints; bodies hang on joints and are covered by trees of spheres (:mod:`apex_ompl.collision`
makes and proves them). Bodies that move together, or nearly so (a hand with its fingers), form a cluster inside one
ball, which is what is looked at first. Every joint frame is turned so that its axis is z.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError, UnknownNameError
from apex_ompl.util.files import is_file, write_atomically
from apex_ompl.util.validation import check_indices

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
    Nodes of the tree are in depth-first order, ``tree_skip`` is
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

    def judging(self, joints: Sequence[int]) -> RobotTables:
        """Return tables that judge only what some of these planned joints move and no other ones do.

        So the arms can be placed one after the other, each against the scene, itself and what does not move.

        Args:
            joints: Numbers of planned joints.

        Raises:
            ParameterError: There is no such joint.
        """
        check_indices(joints, self.dof, "joints", "planned joints")
        a, mine = self.arrays, {int(k) for k in joints}
        movers: list[set[int]] = []  # of each joint; parents come first
        for parent, source in zip(a.joint_parent, a.joint_source, strict=True):
            above = movers[parent] if movers else set()
            movers.append(above | ({int(source)} - {-1}))
        inner = (set() if dof < 0 else {int(dof)} for dof in a.cluster_dof)
        clusters = [movers[j] | own for j, own in zip(a.cluster_joint, inner, strict=True)]
        meets = [bool(m) and bool(c) and c <= mine for m, c in zip(a.cluster_meets_scene, clusters, strict=True)]
        pairs = [bool(both) and both <= mine for both in (clusters[c] | clusters[d] for c, d in a.pair_clusters)]
        arrays = a._replace(
            cluster_meets_scene=np.array(meets, np.int64),
            pair_clusters=a.pair_clusters[pairs],
            pair_common=a.pair_common[pairs],
            pair_bodies=a.pair_bodies[pairs],
        )
        return RobotTables(self.name, self.joint_names, self.body_names, self.numbers, arrays)

    def without_pair(self, first: str, second: str) -> RobotTables:
        """Return tables that do not judge two bodies, by their names, against each other.

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
        arrays = a._replace(pair_bodies=spans, bodies=a.bodies[kept])
        return RobotTables(self.name, self.joint_names, self.body_names, self.numbers, arrays)

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
                arrays = {name: np.ascontiguousarray(data[name]) for name in RobotArrays._fields}
        except Exception as error:  # NumPy and zipfile let many kinds through
            raise FileFormatError(str(path), "", type(error).__name__, "expected kernel tables (.npz)") from error
        found = head.get("schema") if isinstance(head, dict) else head
        if found != SCHEMA:
            raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")
        for name, array in arrays.items():
            wanted = np.int64 if name in WHOLE else np.float64
            if array.dtype != wanted or array.shape[1:] != ROWS.get(name, ()):
                expected = f"expected {np.dtype(wanted)} in rows of shape {ROWS.get(name, ())}"
                raise FileFormatError(str(path), name, f"{array.dtype} {array.shape}", expected)
        from apex_ompl.kernel.table_checks import head_fault, table_fault

        fault = head_fault(head)
        if not fault:
            tables = cls(
                head["name"], tuple(head["joints"]), tuple(head["bodies"]), tuple(head["numbers"]),
                RobotArrays(**arrays),
            )  # fmt: skip
            fault = table_fault(tables)
        if fault:
            raise FileFormatError(str(path), fault, "values that do not fit", "expected tables that fit each other")
        return tables


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
