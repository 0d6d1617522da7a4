"""Makes the tables of clearances of a robot's links, see :mod:`apex_ompl.collision.clearance_tables`.

A table is a grid of cells over the values of one to three joints. Where the exact shapes are not proved apart over a
whole cell (:mod:`apex_ompl.kernel.compiled.check.box_bound`), it is halved along each axis. Links with one joint
between them may be as close as a bearing is at every value of it: small cells need to be proved by THIN alone. Tables
are made for pairs that the sphere covers leave open at some states, those that are open most often first, and those of
three joints last.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.clearance_tables import (
    Cells,
    NearPair,
    clearance_file,
    near_pairs,
    read_clearances,
    table_of,
    table_range,
    write_clearances,
)
from apex_ompl.collision.exact_shapes import PlacedShape, shape_arrays
from apex_ompl.collision.links import Links
from apex_ompl.collision.tables import joint_tree
from apex_ompl.kernel.arrays import pack
from apex_ompl.kernel.box_bound import BoxBounds
from apex_ompl.kernel.clearance_table import LARGEST, THIN, UNIT
from apex_ompl.kernel.products import product
from apex_ompl.robot import Robot
from apex_ompl.types import Array
from apex_ompl.util.files import check_writable, is_file

ROUNDING = 1e-9  # by which cells are widened [rad], [m]
FIRST, LAST = 3, (13, 7, 6)  # levels: 2^n cells along each axis at first, and at last by the number of joints
HOPELESS = (10, 6, 5)  # levels at which tables are given up of which nothing is proved, by the number of joints
SHARE = 1 / 3  # of the time that is left, for one table
SAFE = 1e-6  # by which bounds are lowered [m]
ENOUGH = 5e-4  # bound with which a cell is not divided further [m]
NEAR = 2e-3  # bound that is tried first [m]
FEW, MOSTLY = 16, 0.5  # cells, and share of them without a larger bound, from which larger bounds are given up
SAMPLES = 500  # states at which the covers are tried
MANY = 1 << 17  # pairs of convex pieces of bearings that are examined for one cell
AT_ONCE = 256  # cells between two readings of the clock


@dataclass(frozen=True, eq=False)
class TableReport:
    """What was found for one table.

    Attributes:
        names: Names of the links.
        joints: Names of the planned joints between them.
        unproved: Share of random states at which the covers leave the pair open.
        proved: Share of the range of the joints that the table proves.
        cells: Number of cells along each axis.
        seconds: CPU time [s].
        complete: Whether the time budget sufficed.
    """

    names: tuple[str, str]
    joints: tuple[str, ...]
    unproved: float
    proved: float
    cells: int
    seconds: float
    complete: bool

    def __str__(self) -> str:
        """Return a line for a log."""
        left = "" if self.complete else ", stopped by the time budget"
        return (
            f"{self.names[0]} and {self.names[1]} ({', '.join(self.joints)}): {self.unproved:.1%} of states open by "
            f"covers, {self.proved:.1%} of the range proved, {self.cells} cells an axis, {self.seconds:.1f} s{left}"
        )


class TableMaker:
    """Makes the tables of a robot's pairs of links, those first that the covers leave open most often."""

    def __init__(self, robot: Robot) -> None:
        """Find the pairs of ``robot`` that its covers alone leave open; tables that it has are not used.

        Raises:
            MissingFileError: The robot names a file of covers that cannot be read.
            FileFormatError: That file does not follow its schema.
            RobotError: The kernel does not support the motion of a joint.
        """
        links, tree = Links.of(robot), joint_tree(robot)
        self._robot, self._solids = robot, links.solids
        numbers = links.kernel.robot.numbers
        self._row = {number: row for row, number in enumerate(numbers)}
        bodies = [self._solids[number] for number in numbers]
        arrays = shape_arrays(
            [PlacedShape(s.shape, s.joint, product(tree.turns[s.joint].T, s.placement.homogeneous)) for s in bodies]
        )
        self._radii, self._bounds = arrays.ball[:, 3], BoxBounds(links.kernel, pack(arrays))
        self._dense = set[tuple[int, int]]()  # pairs whose larger bounds take too many triangles
        near, shares = near_pairs(robot, tree, self._solids, links.pairs), _open_shares(robot, links)
        self.pairs = sorted(
            (p for p in near if p.links in shares), key=lambda p: (len(p.sources) // 3, -shares[p.links], p.links)
        )
        self.shares = [shares[pair.links] for pair in self.pairs]

    def names(self, pair: NearPair) -> tuple[str, str]:
        """Return the names of a pair's links."""
        first, second = (self._solids[k] for k in pair.links)
        return first.part or first.name, second.part or second.name

    def bounds(self, pair: NearPair, middles: Array, half: Array, **bounds: Any) -> Array:
        """Return :meth:`apex_ompl.kernel.box_bound.BoxBounds.over` of two links, the smaller of which moves."""
        first, second = sorted((self._row[k] for k in pair.links), key=lambda row: self._radii[row])
        return self._bounds.over(first, second, middles, half, **bounds)

    def _bounds_over(self, pair: NearPair, middles: Array, half: Array, least: float) -> Array:
        """Return lower bounds of the distance of two links over boxes; those below ``least`` are minus infinity [m].

        The smaller the bound that suffices, the fewer triangles are examined: NEAR is tried first, and larger ones for
        pairs of which those do not fail mostly.
        """
        found = self.bounds(pair, middles, half, least=least, need=NEAR + SAFE)
        proved = np.flatnonzero(found >= least)
        if pair.links not in self._dense and len(proved):
            far = self.bounds(pair, middles[proved], half, least=least, need=(LARGEST + 1) * UNIT + SAFE)
            found[proved] = np.maximum(found[proved], far)
            if len(far) >= FEW and np.mean(np.isneginf(far)) > MOSTLY:
                self._dense.add(pair.links)
        return found

    def make(self, pair: NearPair, seconds: float) -> tuple[Cells, bool]:
        """Return the cells of a pair's table, and whether the CPU time sufficed [s]; cells are unproved where not."""
        lower, upper = table_range(self._robot, pair)
        axes, start = list(pair.sources), time.process_time()
        last = LAST[len(axes) - 1]
        for level in range(FIRST, last + 1):
            n = 2**level
            if level == FIRST:
                cells, left = np.zeros((n,) * len(axes), np.uint8), np.ones((n,) * len(axes), bool)
            else:
                cells, left = (_doubled(array) for array in (cells, left))
            width = (upper - lower) / n
            half, middle = np.zeros(self._robot.dof), (self._robot.limits.lower + self._robot.limits.upper) / 2.0
            half[axes] = width / 2.0 + ROUNDING
            enough = UNIT if level == last else ENOUGH
            places = np.argwhere(left)
            for some in np.array_split(places, len(places) // AT_ONCE + 1):
                if time.process_time() - start > seconds:
                    return cells, False
                middles = np.repeat(middle[None], len(some), axis=0)
                middles[:, axes] = lower + (some + 0.5) * width
                bounds, needed = self._bounds_over(pair, middles, half, enough + SAFE), enough
                if len(axes) == 1 and level >= HOPELESS[0] and len(near := np.flatnonzero(bounds < enough + SAFE)):
                    needed, least = THIN, THIN + SAFE
                    bounds[near] = self.bounds(pair, middles[near], half, least=least, need=least + SAFE, most=MANY)
                proved = bounds >= needed + SAFE
                at = tuple(some[proved].T)
                cells[at] = np.clip((bounds[proved] - SAFE) / UNIT, 1, LARGEST)
                left[at] = False
            if not left.any() or (level >= HOPELESS[len(axes) - 1] and not cells.any()):
                break
        return cells, True

    def make_all(
        self, seconds: float, progress: Callable[[TableReport], None] | None = None, known: Mapping[str, Cells] = {}
    ) -> dict[str, Cells]:
        """Return the cells of all tables, by the digests of their pairs.

        Args:
            seconds: CPU time [s].
            progress: Called with what was found for each table that is made.
            known: Tables that were made before; those of other pairs are left out.
        """
        found = {pair.key: known[pair.key] for pair in self.pairs if pair.key in known}
        start = time.process_time()
        for pair, share in zip(self.pairs, self.shares, strict=True):
            began = time.process_time()
            if pair.key in found or began - start > seconds:
                continue
            cells, complete = self.make(pair, SHARE * (seconds - (began - start)))
            if cells.any():
                found[pair.key] = cells
            if progress is not None:
                table, took = table_of(self._robot, pair, cells), time.process_time() - began
                progress(TableReport(self.names(pair), table.joints, share, table.proved, len(cells), took, complete))
        return found


def _open_shares(robot: Robot, links: Links) -> dict[tuple[int, int], float]:
    """Return for pairs of links the share of random states at which the covers leave them open."""
    states = robot.random_state(np.random.default_rng(0), SAMPLES)
    counted = Counter(pair for some in links.open_pairs(states) for pair in (links.pairs if some is None else some))
    return {pair: count / SAMPLES for pair, count in counted.items()}


def _doubled(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array with each element twice along each axis."""
    for axis in range(array.ndim):
        array = np.repeat(array, 2, axis)
    return array


def make_clearances(
    robot: Robot, seconds: float = 60.0, progress: Callable[[TableReport], None] | None = None
) -> dict[str, Cells]:  # fmt: skip
    """Return the cells of the tables of a robot, by the digests of their pairs.

    Args:
        robot: The robot; tables that it has are not used.
        seconds: CPU time for all of them [s]; see above.
        progress: Called with what was found for each table.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
        RobotError: The kernel does not support the motion of a joint.
    """
    return TableMaker(robot).make_all(seconds, progress)


def prepare_clearances(
    robot: Robot, seconds: float = 60.0, progress: Callable[[TableReport], None] | None = None
) -> Path | None:  # fmt: skip
    """Make the tables that a robot's file lacks, and write them; return the file, or None where there is no table.

    Tables of other robots, or of this one before it was changed, are removed from it.

    Args:
        robot: The robot.
        seconds: CPU time [s], see :func:`make_clearances`.
        progress: See :func:`make_clearances`.

    Raises:
        MissingFileError: The robot's covers cannot be read, or the folder of the file cannot be written.
        FileFormatError: One of these files does not follow its schema.
        RobotError: The kernel does not support the motion of a joint.
    """
    path = clearance_file(robot)
    check_writable(path)
    made = TableMaker(robot).make_all(seconds, progress, read_clearances(path) if is_file(path) else {})
    if not made and not is_file(path):
        return None
    write_clearances(path, made)
    return path
