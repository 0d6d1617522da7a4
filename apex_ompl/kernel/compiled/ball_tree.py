"""Binary trees over triangles or points: their order, and the balls of the nodes."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers


@inlined
def _select(centers: Floats, order: Integers, axis: int, first: int, last: int, middle: int) -> None:
    """Order the items of a range so that those before ``middle`` are not behind it along an axis (quickselect)."""
    low, high = first, last - 1
    while low < high:
        pivot = centers[order[(low + high) // 2], axis]
        i, j = low, high
        while i <= j:
            while centers[order[i], axis] < pivot:
                i += 1
            while centers[order[j], axis] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i, j = i + 1, j - 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@entry_point
def median_order(centers: Floats, order: Integers, ranges: Integers) -> None:
    """Order items so that the halves of any range that halving leads to are apart along its longest side.

    Args:
        centers: Places of the items, shape (N, 3).
        order: Numbers of the items, shape (N,).
        ranges: Room for ranges that wait, shape (n, 2), n longer than twice the depth of the tree.
    """
    top = 1
    ranges[0, 0], ranges[0, 1] = 0, len(order)
    while top > 0:
        top -= 1
        first, last = ranges[top, 0], ranges[top, 1]
        if last - first < 3:
            continue
        axis, longest = 0, -1.0
        for i in range(3):
            low, high = math.inf, -math.inf
            for k in range(first, last):
                low, high = min(low, centers[order[k], i]), max(high, centers[order[k], i])
            if high - low > longest:
                axis, longest = i, high - low
        middle = (first + last) // 2
        _select(centers, order, axis, first, last, middle)
        ranges[top, 0], ranges[top, 1], ranges[top + 1, 0], ranges[top + 1, 1] = first, middle, middle, last
        top += 2


@entry_point
def node_balls(corners: Floats, first: Integers, last: Integers, balls: Floats, halves: Floats) -> None:
    """Write for each node the bounding box of the corners of its triangles, and a ball around them with its center.

    Args:
        corners: Corners of triangles, or points, shape (T, k, 3) [m].
        first: First triangle of each node, shape (n,).
        last: The one behind its last, shape (n,).
        balls: Gets center and radius, shape (n, 4) [m].
        halves: Gets the half edges of the boxes, shape (n, 3) [m].
    """
    for n in range(len(first)):
        for i in range(3):
            low, high = math.inf, -math.inf
            for t in range(first[n], last[n]):
                for k in range(corners.shape[1]):
                    low, high = min(low, corners[t, k, i]), max(high, corners[t, k, i])
            balls[n, i], halves[n, i] = 0.5 * (low + high), 0.5 * (high - low) + 1e-12
        most = 0.0
        for t in range(first[n], last[n]):
            for k in range(corners.shape[1]):
                x, y, z = corners[t, k, 0] - balls[n, 0], corners[t, k, 1] - balls[n, 1], corners[t, k, 2] - balls[n, 2]
                most = max(most, x * x + y * y + z * z)
        balls[n, 3] = math.sqrt(most) + 1e-12
