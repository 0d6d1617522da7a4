"""Trees of boxes over buckets of points or triangles, and binary trees of balls over them.

The tree of boxes tells whether a ball is apart from all items of an obstacle. It is perfect: node n has the children
2 n + 1 and 2 n + 2, and each node of the lowest level holds a bucket of adjacent items. Boxes and items are single
precision numbers in the frame of the obstacle's grid of distances, whose bounds are too low by some share of its
spacing; the tree is asked where they do not suffice.

The tree of balls serves exact distances of meshes and clouds: its items are in median order, and each node has a ball
and a box around a range of them.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.geometry.triangles import squared_distance
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles

BUCKET = 8  # items of a bucket, at most
BITS = 10  # of a place along an axis
HALF = 15  # of the bits of a place on Morton's curve
POINT, TRIANGLE = 3, 9  # numbers of an item
ROUNDING = 1e-6  # by which single precision may move an item [m]


@inlined
def _spread(x: int) -> int:
    """Return a number of BITS bits with two zeros after each bit."""
    x = (x | (x << 16)) & 0x030000FF
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249


@inlined
def _sort_by(source: Integers, target: Integers, shift: int, counts: Integers) -> None:
    """Copy numbers in the order of some of their bits, as many as ``counts`` tells apart (a pass of a radix sort)."""
    for k in range(len(counts)):
        counts[k] = 0
    mask = len(counts) - 1
    for n in range(len(source)):
        counts[(source[n] >> shift) & mask] += 1
    total = 0
    for k in range(len(counts)):
        counts[k], total = total, total + counts[k]
    for n in range(len(source)):
        k = (source[n] >> shift) & mask
        target[counts[k]] = source[n]
        counts[k] += 1


@entry_point
def order_items(corners: Floats, low: Floats, extent: float, keys: Integers, counts: Integers, items: Singles) -> None:
    """Copy points or triangles so that those that stand next to each other are near each other (Morton's curve).

    Args:
        corners: Shape (N, 1 or 3, 3) [m].
        low: Lowest corner of all, shape (3,) [m].
        extent: Longest side of the box around them [m].
        keys: Buffer, shape (2, N); N is less than 2^32.
        counts: Buffer, shape (2^HALF,).
        items: Gets the corners less ``low``, shape (N, 3 or 9) [m].
    """
    number, last = corners.shape[1], (1 << BITS) - 1
    scale = (1 << BITS) / extent if extent > 0.0 else 0.0
    for n in range(len(corners)):
        key = 0
        for axis in range(3):
            total = 0.0
            for k in range(number):
                total += corners[n, k, axis] - low[axis]
            key |= _spread(min(int(total / number * scale), last)) << axis
        keys[0, n] = (key << 32) | n
    _sort_by(keys[0], keys[1], 32, counts)
    _sort_by(keys[1], keys[0], 32 + HALF, counts)
    for m in range(len(items)):
        n = keys[0, m] & 0xFFFFFFFF
        for k in range(number):
            for axis in range(3):
                items[m, 3 * k + axis] = corners[n, k, axis] - low[axis]


@entry_point
def fill_boxes(items: Singles, levels: int, boxes: Singles) -> None:
    """Write the lowest and highest corners of the boxes of a tree.

    Args:
        items: Shape (N, POINT or TRIANGLE) [m].
        levels: Levels below the root.
        boxes: Gets the corners, shape (2^(levels + 1) - 1, 6) [m].
    """
    (count, width), leaves = items.shape, 1 << levels
    for k in range(leaves):
        box = boxes[leaves - 1 + k]
        for axis in range(3):
            low, high = math.inf, -math.inf
            for n in range(count * k // leaves, count * (k + 1) // leaves):
                for m in range(axis, width, 3):
                    low, high = min(low, items[n, m]), max(high, items[n, m])
            box[axis], box[3 + axis] = low, high
    for n in range(leaves - 2, -1, -1):
        for axis in range(3):
            boxes[n, axis] = min(boxes[2 * n + 1, axis], boxes[2 * n + 2, axis])
            boxes[n, 3 + axis] = max(boxes[2 * n + 1, 3 + axis], boxes[2 * n + 2, 3 + axis])


@inlined
def _corner(item: Singles, k: int) -> tuple[float, float, float]:
    """Return three numbers of an item in double precision, in which a triangle's closest point is to be computed."""
    return np.float64(item[k]), np.float64(item[k + 1]), np.float64(item[k + 2])


@outlined
def items_apart(grid: Integers, values: Singles, a: float, b: float, c: float, reach: float) -> bool:
    """Whether all items are farther than ``reach`` [m] from a point in the frame of a grid.

    Args:
        grid: Row of the grid: from its fifth number on the place of the boxes in ``values``, levels, number of items
            and numbers of each.
        values: Values of all grids and trees.
        a: Place of the point [m].
        b: The same.
        c: The same.
        reach: The distance [m].
    """
    place, levels, count, width = grid[4], grid[5], grid[6], grid[7]
    leaves, squared = 1 << levels, (reach + ROUNDING) ** 2
    items, n = place + 6 * (2 * leaves - 1), 0
    while True:
        box = values[place + 6 * n : place + 6 * n + 6]
        x, y, z = max(box[0] - a, a - box[3], 0.0), max(box[1] - b, b - box[4], 0.0), max(box[2] - c, c - box[5], 0.0)
        if not x * x + y * y + z * z > squared:
            if n < leaves - 1:
                n = 2 * n + 1
                continue
            k = n - leaves + 1
            for m in range(count * k // leaves, count * (k + 1) // leaves):
                item = values[items + width * m : items + width * (m + 1)]
                if width == POINT:
                    d = (item[0] - a) ** 2 + (item[1] - b) ** 2 + (item[2] - c) ** 2
                else:
                    d = squared_distance(_corner(item, 0), _corner(item, 3), _corner(item, 6), a, b, c)
                if not d > squared:
                    return False
        while n > 0 and n % 2 == 0:  # up from a right child
            n = (n - 1) // 2
        if n == 0:
            return True
        n += 1


@inlined
def _select(centers: Floats, order: Integers, axis: int, first: int, last: int, middle: int) -> None:
    """Order the items of a range so that those before ``middle`` are not after it along an axis (quickselect)."""
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
        ranges: Buffer for ranges that wait, shape (n, 2), n longer than twice the depth of the tree.
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
        last: The one after its last, shape (n,).
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
