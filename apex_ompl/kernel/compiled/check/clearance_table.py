"""Tables of lower bounds of the distance of two bodies whose relative pose depends on one to three planned joints.

A table is a grid of cells over the values of these joints, 2^L along each axis. Each cell holds a lower bound of the
distance for all values in it, in units of UNIT, as one byte; 0 where the bodies are not proved apart. Coarser grids
follow, each with half as many cells along each axis, whose cells hold the least value of those that they consist of.
A box of joint values is looked up in the finest grid of which it meets at most ACROSS cells along each axis.
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import RobotArrays
from apex_ompl.kernel.compiled.compilation import inlined, outlined
from apex_ompl.kernel.compiled.layout import Floats

UNIT = 1e-4  # of the bounds [m]
LARGEST = 255  # bound in these units
ACROSS = 4  # most cells along an axis that are read


@inlined
def _value(t: RobotArrays, place: int) -> int:
    return int((t.table_bytes[place >> 3] >> ((place & 7) << 3)) & 255)


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


@outlined
def clearance_of_cell(t: RobotArrays, k: int, q: Floats) -> float:
    """Return a lower bound of the distance of the bodies of pair ``k``, which has a table, at a state [m]."""
    e = t.bodies_table[k]
    x, y, z, n = _cell(t, e, 0, q, 0.0), _cell(t, e, 1, q, 0.0), _cell(t, e, 2, q, 0.0), t.table_cells[e, 1]
    if not (0.0 <= x < n and 0.0 <= y < n and 0.0 <= z < n):  # NaN is in no cell
        return 0.0
    place = int(x)
    if t.table_joints[e, 1] >= 0:
        place = place * n + int(y)
    if t.table_joints[e, 2] >= 0:
        place = place * n + int(z)
    return UNIT * _value(t, t.table_cells[e, 0] + place)


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
    x, y, z = _width(t, e, 0, half_width), _width(t, e, 1, half_width), _width(t, e, 2, half_width)
    x, u = _cell(t, e, 0, q, -x), _cell(t, e, 0, q, x)
    y, v = _cell(t, e, 1, q, -y), _cell(t, e, 1, q, y)
    z, w = _cell(t, e, 2, q, -z), _cell(t, e, 2, q, z)
    if not (0.0 <= x <= u < n and 0.0 <= y <= v < n and 0.0 <= z <= w < n):
        return 0.0
    a, b, c, d, f, g = int(x), int(u), int(y), int(v), int(z), int(w)
    rows = n if t.table_joints[e, 1] >= 0 else 1
    columns = n if t.table_joints[e, 2] >= 0 else 1
    while b - a >= ACROSS or d - c >= ACROSS or g - f >= ACROSS:
        first += n * rows * columns
        a, b, c, d, f, g = a >> 1, b >> 1, c >> 1, d >> 1, f >> 1, g >> 1
        n, rows, columns = n >> 1, max(rows >> 1, 1), max(columns >> 1, 1)
    least = LARGEST
    for i in range(a, b + 1):
        for j in range(c, d + 1):
            place = first + (i * rows + j) * columns
            for m in range(f, g + 1):
                least = min(least, _value(t, place + m))
    return UNIT * least
