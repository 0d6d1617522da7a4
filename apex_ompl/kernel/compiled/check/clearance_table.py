"""Tables of lower bounds of the distance of two bodies whose relative pose depends on one or two planned joints.

A table is a grid of cells over the values of these joints, 2^L along each axis. Each cell holds a lower bound of the
distance for all values in it, in units of UNIT, as one byte; 0 where the bodies are not proved apart. Coarser grids
follow, each with half as many cells along each axis, whose cells hold the least value of those that they consist of.
A box of joint values is looked up in the finest grid of which it meets at most ACROSS cells along each axis.
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import RobotArrays
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats

UNIT = 1e-4  # of the bounds [m]
LARGEST = 255  # bound in these units
ACROSS = 4  # most cells along an axis that are read


@inlined
def _value(t: RobotArrays, place: int) -> int:
    return int((t.table_bytes[place >> 3] >> ((place & 7) << 3)) & 255)


@inlined
def clearance_of_cell(t: RobotArrays, k: int, q: Floats) -> float:
    """Return a lower bound of the distance of the bodies of pair ``k``, which has a table, at a state [m]."""
    e = t.bodies_table[k]
    i, j, n, y = t.table_joints[e, 0], t.table_joints[e, 1], t.table_cells[e, 1], 0.0
    x = (q[i] - t.table_range[e, 0, 0]) * t.table_range[e, 0, 1]
    if j >= 0:
        y = (q[j] - t.table_range[e, 1, 0]) * t.table_range[e, 1, 1]
    if not (0.0 <= x < n and 0.0 <= y < n):  # NaN is in no cell
        return 0.0
    place = int(x) * n + int(y) if j >= 0 else int(x)
    return UNIT * _value(t, t.table_cells[e, 0] + place)


@inlined
def clearance_of_box(t: RobotArrays, k: int, q: Floats, half_width: Floats) -> float:
    """Return a lower bound of the distance of the bodies of pair ``k``, which has a table, over a box of states [m].

    Args:
        t: The robot.
        k: The pair, of ``bodies``.
        q: State in the middle of the box, shape (dof,).
        half_width: Half widths of the box, shape (dof,).
    """
    e = t.bodies_table[k]
    i, j, n, u, v = t.table_joints[e, 0], t.table_joints[e, 1], t.table_cells[e, 1], 0.0, 0.0
    x = (q[i] - half_width[i] - t.table_range[e, 0, 0]) * t.table_range[e, 0, 1]
    y = (q[i] + half_width[i] - t.table_range[e, 0, 0]) * t.table_range[e, 0, 1]
    if j >= 0:
        u = (q[j] - half_width[j] - t.table_range[e, 1, 0]) * t.table_range[e, 1, 1]
        v = (q[j] + half_width[j] - t.table_range[e, 1, 0]) * t.table_range[e, 1, 1]
    if not (0.0 <= x <= y < n and 0.0 <= u <= v < n):
        return 0.0
    a, b, c, d, first = int(x), int(y), int(u), int(v), t.table_cells[e, 0]
    while b - a >= ACROSS or d - c >= ACROSS:
        first += n * n if j >= 0 else n
        a, b, c, d, n = a >> 1, b >> 1, c >> 1, d >> 1, n >> 1
    least = LARGEST
    for row in range(a, b + 1):
        place = first + (row * n if j >= 0 else row)
        for column in range(c, d + 1):
            least = min(least, _value(t, place + column))
    return UNIT * least
