"""Tables of lower bounds of the distance of two bodies whose relative pose depends on one to three planned joints.

A table is a grid of cells over the values of these joints, 2^L along each axis. Each cell holds a lower bound of the
distance for all values in it, in units of UNIT, as one byte; 0 where the bodies are not proved apart, and 1 where they
are, by THIN at least. Bearings are so near at all values of their joint, and do not count for a least clearance.
Coarser grids follow, each with half as many cells along each axis, whose cells hold the least value of those that they
consist of. A box of joint values is looked up in the finest grid of which it meets at most ACROSS cells along each
axis. The cells of a continuous joint are those of a whole turn, which repeat.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import RobotArrays
from apex_ompl.kernel.compiled.compilation import inlined, outlined
from apex_ompl.kernel.compiled.layout import Floats

UNIT = 1e-4  # of the bounds [m]
THIN = 1e-5  # bound that 1 stands for [m]
LARGEST = 255  # bound in these units
BEARING = -2  # stands for the second joint of a table of a bearing, which has one
ACROSS = 4  # most cells along an axis that are read
MOST_CELLS = 1e9  # from the first one, of a continuous joint


@inlined
def _value(t: RobotArrays, place: int) -> int:
    return int((t.table_bytes[place >> 3] >> ((place & 7) << 3)) & 255)


@inlined
def _bound(value: int) -> float:
    return UNIT * value if value > 1 else THIN * value


@inlined
def _cell(t: RobotArrays, e: int, axis: int, q: Floats, by: float) -> float:
    """Return where the value of a joint, plus ``by``, is on an axis of table ``e``, in cells; 0 for no joint."""
    joint, place = t.table_joints[e, axis], 0.0
    if joint >= 0:
        place = (q[joint] + by - t.table_range[e, axis, 0]) * t.table_range[e, axis, 1]
    return place


@inlined
def _width(t: RobotArrays, e: int, axis: int, half_width: Floats) -> float:
    joint, width = t.table_joints[e, axis], 0.0
    if joint >= 0:
        width = half_width[joint]
    return width


@inlined
def _endless(t: RobotArrays, e: int, axis: int) -> bool:
    """Whether an axis of table ``e`` is a continuous joint, so that its cells repeat."""
    joint, endless = t.table_joints[e, axis], False
    if joint >= 0:
        endless = t.continuous[joint] != 0
    return endless


@inlined
def _cells(t: RobotArrays, e: int, axis: int, q: Floats, half_width: Floats) -> tuple[int, int, bool]:
    """Return the first and last cell that a box meets along an axis of table ``e``, and whether the table has it.

    Cells of a continuous joint may be below 0 or beyond the last, for cell + n; they are all where it turns so far.
    """
    n, width = t.table_cells[e, 1], _width(t, e, axis, half_width)
    low, high = _cell(t, e, axis, q, -width), _cell(t, e, axis, q, width)
    if not _endless(t, e, axis):
        if 0.0 <= low <= high < n:  # NaN is in no cell
            return int(low), int(high), True
        return 0, 0, False
    if not -MOST_CELLS <= low <= high <= MOST_CELLS:
        return 0, 0, False
    first, last = int(math.floor(low)), int(math.floor(high))
    if last - first >= n:
        first, last = 0, n - 1
    return first, last, True


@outlined
def clearance_of_cell(t: RobotArrays, k: int, q: Floats) -> float:
    """Return a lower bound of the distance of the bodies of pair ``k``, which has a table, at a state [m]."""
    e = t.bodies_table[k]
    n, place = t.table_cells[e, 1], 0
    for axis in range(3):
        if t.table_joints[e, axis] < 0:
            break
        at = _cell(t, e, axis, q, 0.0)
        if _endless(t, e, axis) and -MOST_CELLS <= at <= MOST_CELLS:
            at = float(int(math.floor(at)) & (n - 1))
        if not 0.0 <= at < n:  # NaN is in no cell
            return 0.0
        place = place * n + int(at)
    return _bound(_value(t, t.table_cells[e, 0] + place))


@outlined
def clearance_of_box(t: RobotArrays, k: int, q: Floats, half_width: Floats) -> float:
    """Return a lower bound of the distance of the bodies of pair ``k``, which has a table, over a box of states [m].

    Args:
        t: The robot.
        k: The pair, of ``bodies``.
        q: State in the middle of the box, shape (dof,).
        half_width: Half widths of the box, shape (dof,).
    """
    e = t.bodies_table[k]
    n, first = t.table_cells[e, 1], t.table_cells[e, 0]
    a, b, x = _cells(t, e, 0, q, half_width)
    c, d, y = _cells(t, e, 1, q, half_width)
    f, g, z = _cells(t, e, 2, q, half_width)
    if not (x and y and z):
        return 0.0
    rows = n if t.table_joints[e, 1] >= 0 else 1
    columns = n if t.table_joints[e, 2] >= 0 else 1
    while b - a >= ACROSS or d - c >= ACROSS or g - f >= ACROSS:
        first += n * rows * columns
        a, b, c, d, f, g = a >> 1, b >> 1, c >> 1, d >> 1, f >> 1, g >> 1
        n, rows, columns = n >> 1, max(rows >> 1, 1), max(columns >> 1, 1)
    least = LARGEST
    for i in range(a, b + 1):
        for j in range(c, d + 1):
            place = first + ((i & (n - 1)) * rows + (j & (rows - 1))) * columns
            for m in range(f, g + 1):
                least = min(least, _value(t, place + (m & (columns - 1))))
    return _bound(least)


@inlined
def is_bearing(t: RobotArrays, k: int, bound: float) -> bool:
    """Whether a bound by the table of pair ``k`` is that of a bearing."""
    return bound == THIN and t.table_joints[t.bodies_table[k], 1] == BEARING


@inlined
def proved_by_table(t: RobotArrays, k: int, q: Floats, half_width: Floats, margin: float) -> bool:
    """Whether its table proves pair ``k`` apart over a box of states, by a margin unless it is a bearing."""
    bound = clearance_of_box(t, k, q, half_width)
    return bound > margin or is_bearing(t, k, bound)
