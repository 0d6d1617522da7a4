"""Distances of points from a polyline."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats


@inlined
def _squared_distance(points: Floats, n: int, path: Floats, k: int) -> float:
    """Return the squared distance of point ``n`` from segment ``k`` of a polyline."""
    along, squared = 0.0, 0.0
    for j in range(points.shape[1]):
        side = path[k + 1, j] - path[k, j]
        along += (points[n, j] - path[k, j]) * side
        squared += side * side
    share = min(max(along / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    squared_distance = 0.0
    for j in range(points.shape[1]):
        difference = points[n, j] - path[k, j] - share * (path[k + 1, j] - path[k, j])
        squared_distance += difference * difference
    return squared_distance


@entry_point
def max_distance(points: Floats, places: Floats, path: Floats, arc: Floats, window: float) -> float:
    """Return the largest distance of points from a polyline, each from the part near its own arc length.

    Args:
        points: Shape (N, dof).
        places: Their arc lengths, ascending, shape (N,).
        path: States of the polyline, two or more, shape (M, dof).
        arc: Arc lengths of its states, shape (M,).
        window: Half length of that part.
    """
    middle, worst, last = 0, 0.0, arc.shape[0] - 2
    for n in range(points.shape[0]):
        while middle < last and arc[middle + 1] < places[n]:
            middle += 1
        least = _squared_distance(points, n, path, middle)
        before, after = middle - 1, middle + 1
        while least > worst:  # a smaller distance does not change the maximum
            more = after <= last and arc[after] <= places[n] + window
            less = before >= 0 and arc[before + 1] >= places[n] - window
            if not more and not less:
                break
            if more:
                least = min(least, _squared_distance(points, n, path, after))
                after += 1
            if less:
                least = min(least, _squared_distance(points, n, path, before))
                before -= 1
        worst = max(worst, least)
    return math.sqrt(worst)
