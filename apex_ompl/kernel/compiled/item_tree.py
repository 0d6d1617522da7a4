"""Whether a ball is apart from all points, or triangles, of an obstacle, by a tree of boxes over buckets of them.

The tree is perfect: node n has the children 2 n + 1 and 2 n + 2, and each node of the lowest level holds a bucket of
items that stand next to each other. Boxes and items are single precision numbers in the frame of the obstacle's grid
of distances, whose bounds are too low by some share of its spacing; the tree is asked where they do not suffice.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.triangle_distance import squared_distance

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
        keys: Room, shape (2, N); N is less than 2^32.
        counts: Room, shape (2^HALF,).
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
