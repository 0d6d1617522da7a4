"""Tables of a robot and of a scene: their flat arrays with names, as files, and cut to some joints or pairs."""

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
from apex_ompl.kernel.compiled.arrays import BINS, RUN, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.layout import Floats, Integers, layout, pack
from apex_ompl.kernel.distance_grid import DistanceGrid
from apex_ompl.kernel.table_checks import MADE, head_fault, robot_fault
from apex_ompl.types import Flags
from apex_ompl.util.files import is_file, write_atomically
from apex_ompl.util.validation import check_indices

SCHEMA = "apex-ompl/kernel-tables/1"
PAIRS = ("pair_clusters", "pair_common", "pair_bodies", "pair_ball", "pair_outer", "pair_parts")
STORED = tuple(name for name in RobotArrays._fields if name not in MADE)


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
        arrays = a._replace(pair_bodies=spans, bodies=a.bodies[kept])
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
