"""Farthest of many points in some directions."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.layout import Floats, Integers


@entry_point
def farthest_points(
    directions: Floats, points: Floats, first: Integers, middles: Floats, half: float, found: Integers
) -> None:
    """Find the point that is farthest in each direction; of points in cells only those in cells that may hold it.

    Args:
        directions: Shape (D, 3).
        points: Points in the order of their cells, shape (N, 3) [m].
        first: First point of each cell, and N, shape (cells + 1,).
        middles: Middles of the cells, shape (cells, 3) [m].
        half: Half of a cell's side, and what rounding may add [m].
        found: Gets the number of a point for each direction, shape (D,).
    """
    for k in range(len(directions)):
        x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
        wide, best = half * (abs(x) + abs(y) + abs(z)), -math.inf
        for c in range(len(middles)):  # a bound to begin with
            n = first[c]
            reach = x * points[n, 0] + y * points[n, 1] + z * points[n, 2]
            if reach > best:
                best, found[k] = reach, n
        for c in range(len(middles)):
            if x * middles[c, 0] + y * middles[c, 1] + z * middles[c, 2] + wide <= best:
                continue
            for n in range(first[c], first[c + 1]):
                reach = x * points[n, 0] + y * points[n, 1] + z * points[n, 2]
                if reach > best:
                    best, found[k] = reach, n
