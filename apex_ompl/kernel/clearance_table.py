"""Tables of clearances of two bodies over the values of one to three joints, as arrays of the kernel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.check.clearance_table import BEARING, LARGEST, THIN, UNIT
from apex_ompl.types import Array

__all__ = ["LARGEST", "THIN", "UNIT", "ClearanceTable", "table_arrays"]

NO_AXES = ((0.0, 0.0), (0.0, 0.0))
MOSTLY_THIN = 0.1  # least share of a joint's range in which bearings are apart by THIN


@dataclass(frozen=True, eq=False)
class ClearanceTable:
    """Lower bounds of the distance of two bodies whose relative pose depends on one to three planned joints.

    Attributes:
        joints: Names of the joints.
        lower: Lowest value of each, shape (1,) to (3,) [rad], [m].
        upper: Highest value of each.
        cells: Lower bounds in units of UNIT over cells of equal size, n a power of two along each axis; 0 where the
            bodies are not proved apart, 1 for THIN.
    """

    joints: tuple[str, ...]
    lower: Array
    upper: Array
    cells: NDArray[np.uint8]

    @property
    def proved(self) -> float:
        """Share of the range of the joints for which the bodies are proved apart."""
        return float(np.mean(self.cells > 0))

    @property
    def is_bearing(self) -> bool:
        """Whether the bodies turn or slide beside each other, as near as they may be, over some of a joint's range."""
        return len(self.joints) == 1 and float(np.mean(self.cells == 1)) >= MOSTLY_THIN

    def levels(self) -> list[NDArray[np.uint8]]:
        """Return the cells and the least values of ever larger ones, down to a single one."""
        found = [self.cells]
        while len(found[-1]) > 1:
            cells = found[-1]
            for axis in range(cells.ndim):
                even, odd = (np.take(cells, range(k, cells.shape[axis], 2), axis) for k in (0, 1))
                cells = np.minimum(even, odd)
            found.append(cells)
        return found


def table_arrays(tables: Sequence[ClearanceTable | None], joint_names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return the arrays of :class:`apex_ompl.kernel.arrays.RobotArrays` for the tables of pairs of bodies.

    Args:
        tables: The table of each pair, None for one without.
        joint_names: Planned joints in state order, among them those of the tables.
    """
    rows: list[int] = []
    joints: list[list[int]] = []
    cells: list[tuple[int, int]] = []
    ranges: list[list[tuple[float, float]]] = []
    content, size = [np.empty(0, np.uint8)], 0
    for table in tables:
        if table is None:
            rows.append(-1)
            continue
        rows.append(len(cells))
        dofs = [joint_names.index(name) for name in table.joints]
        per_unit = len(table.cells) / (table.upper - table.lower)
        joints.append([*dofs, BEARING, -1] if table.is_bearing else (dofs + [-1, -1])[:3])
        ranges.append([*zip(table.lower, per_unit, strict=True), *NO_AXES][:3])
        cells.append((size, len(table.cells)))
        levels = [level.ravel() for level in table.levels()]
        content += levels
        size += sum(map(len, levels))
    packed = np.concatenate([*content, np.zeros(-size % 8, np.uint8)])
    return {
        "bodies_table": np.array(rows, np.int64), "table_joints": np.array(joints, np.int64).reshape(-1, 3),
        "table_cells": np.array(cells, np.int64).reshape(-1, 2), "table_range": np.array(ranges).reshape(-1, 3, 2),
        "table_bytes": packed.view("<i8").astype(np.int64),
    }  # fmt: skip
