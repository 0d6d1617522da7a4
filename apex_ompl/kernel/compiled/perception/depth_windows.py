"""Depths of an image in the order in which voxels are looked up in it: least depths of windows, and supported points.

Pixels stand in the order of square blocks of the plane at depth 1 of the optical frame, so that distortion is no matter
here. Numbers are of single precision.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Bytes, Floats, Integers, Singles

UNSEEN = 0.0  # depth of a cell that is not known
TILE = 4  # cells along a side of the tiles whose largest depths are kept
LEVELS = 6  # of windows of cells


@inlined
def _filled(near: Singles, first: Integers, missing: float, i: int, j: int) -> float:
    """Return the least depth of the 3x3 cells around one, UNSEEN where too many of their pixels have none."""
    _, rows, columns = near.shape
    low, gaps, count = math.inf, 0.0, 0
    for a in range(max(i - 1, 0), min(i + 2, rows)):
        for b in range(max(j - 1, 0), min(j + 2, columns)):
            low, gaps = min(low, near[1, a, b]), gaps + near[2, a, b]
            count += first[a * columns + b + 1] - first[a * columns + b]
    return low if gaps <= missing * count else UNSEEN


@inlined
def _widen(near: Singles, level: int) -> None:
    """Find the least depths of the windows of a level from those of the level below."""
    rows, columns, half = near.shape[1], near.shape[2], 1 << (level - 1)
    high, wide = max(rows - 2 * half + 1, 0), max(columns - 2 * half + 1, 0)
    below, found = near[level - 1], near[level]
    for i in range(rows):
        for j in range(wide if i < high else 0):
            found[i, j] = min(below[i, j], below[i, j + half], below[i + half, j], below[i + half, j + half])
        for j in range(wide if i < high else 0, columns):
            found[i, j] = UNSEEN


@entry_point
def cell_depths(
    depths: Singles, first: Integers, whole: Bytes, nearest: float, farthest: float, missing: float, near: Singles,
    far: Singles,
) -> None:  # fmt: skip
    """Find the least depths of cells and of square windows of them, and the largest depths of tiles.

    A cell without a depth for too many of its pixels has the least depth of the 3x3 cells around it, if these have
    enough.

    Args:
        depths: Depths of the pixels in the order of cells, shape (P,) [m]; UNSEEN where there is none.
        first: First pixel of each cell, and P, shape (rows columns + 1,).
        whole: Whether the image holds a cell as a whole, shape (rows columns,).
        nearest: Smallest depth that counts [m].
        farthest: Depth up to which a larger one shows the space to be free [m].
        missing: Largest share of pixels without a depth.
        near: Gets the least depths of windows of 2^n x 2^n cells that begin at a cell, shape (levels, rows, columns)
            [m]; UNSEEN where one of them is not known, or outside of the image. There are three levels at least.
        far: Gets the largest depth of a cell in each tile of TILE x TILE cells, shape (rows / TILE, columns / TILE),
            rounded up [m].
    """
    levels, rows, columns = near.shape
    for i in range(rows):
        for j in range(columns):
            cell, gaps, low = i * columns + j, 0, farthest
            for p in range(first[cell], first[cell + 1]):
                if depths[p] >= nearest:
                    low = min(low, depths[p])
                else:
                    gaps += 1
            near[1, i, j], near[2, i, j] = low, gaps
    for i in range(far.shape[0]):
        for j in range(far.shape[1]):
            far[i, j] = UNSEEN
    for i in range(rows):
        for j in range(columns):
            cell = i * columns + j
            low, count = near[1, i, j], first[cell + 1] - first[cell]
            if whole[cell] == 0:
                low = UNSEEN
            elif count == 0 or near[2, i, j] > missing * count:
                low = _filled(near, first, missing, i, j)
            near[0, i, j] = low
            far[i // TILE, j // TILE] = max(far[i // TILE, j // TILE], low)
    for level in range(1, levels):
        _widen(near, level)


@entry_point
def supported_depths(image: Singles, noise: float, slack: float, least: int, found: Singles) -> None:
    """Take depths at a stride, UNSEEN where too few of the 8 pixels around have about the same.

    Args:
        image: Depths, shape (height, width) [m]; UNSEEN where there is none.
        noise: Depths z differ by at most ``noise`` z^2 and ``slack`` [1/m].
        slack: See ``noise`` [m].
        least: How many of the 8 pixels must.
        found: Gets the depths, shape (rows, columns) [m]; the strides are quotients of the shapes, rounded up.
    """
    height, width = image.shape
    rows, columns = found.shape
    step, pace = (height + rows - 1) // rows, (width + columns - 1) // columns
    for i in range(rows):
        for j in range(columns):
            v, u = i * step, j * pace
            depth = image[v, u]
            limit, count = noise * depth * depth + slack, 0
            if depth > UNSEEN:
                for a in range(max(v - 1, 0), min(v + 2, height)):
                    for b in range(max(u - 1, 0), min(u + 2, width)):
                        count += abs(image[a, b] - depth) <= limit
                    if count > least:
                        break
            found[i, j] = depth if count > least else UNSEEN


@inlined
def _tangents(across: float, along: float, radius: float) -> tuple[float, float]:
    """Return the least and the largest x / z of a circle about x = ``across``, z = ``along``, more than its radius."""
    square = across * across + along * along - radius * radius
    turn, bottom = radius * math.sqrt(square), along * along - radius * radius
    return (across * along - turn) / bottom, (across * along + turn) / bottom


@inlined
def _all_inside(
    depths: Singles, rays: Singles, first: int, last: int, center: tuple[float, float, float], radius: float,
    inside: Bytes,
) -> bool:  # fmt: skip
    """Mark the pixels of a block whose points are inside of a sphere; return whether all of its points are marked."""
    found = True
    for p in range(first, last):
        depth = depths[p]
        if depth > UNSEEN and inside[p] == 0:
            a, b, c = rays[p, 0] * depth - center[0], rays[p, 1] * depth - center[1], depth - center[2]
            if a * a + b * b + c * c <= radius * radius:
                inside[p] = 1
            else:
                found = False
    return found


@entry_point
def mark_inside(
    depths: Singles, rays: Singles, first: Integers, plane: Floats, columns: int, spheres: Floats, ranges: Singles,
    inside: Bytes,
) -> None:  # fmt: skip
    """Mark the pixels whose points are inside of any sphere.

    Args:
        depths: Depths of the pixels in the order of blocks, shape (P,) [m].
        rays: Their points at depth 1, shape (P, 2).
        first: First pixel of each block, and P, shape (rows columns + 1,).
        plane: Corner of the first block and sides of a block at depth 1, shape (2, 2).
        columns: Columns of blocks.
        spheres: Centers in the optical frame and radii, shape (S, 4) [m].
        ranges: Gets the least and the largest depth of each block, shape (rows columns, 2) [m]; inf as the least where
            all points of a block are marked.
        inside: Gets 1 for these pixels, shape (P,); 0 at the start.
    """
    rows = (len(first) - 1) // columns
    for block in range(rows * columns):
        low, high = math.inf, UNSEEN
        for p in range(first[block], first[block + 1]):
            if depths[p] > UNSEEN:
                low, high = min(low, depths[p]), max(high, depths[p])
        ranges[block, 0], ranges[block, 1] = low, high
    for s in range(len(spheres)):
        x, y, z, radius = spheres[s, 0], spheres[s, 1], spheres[s, 2], spheres[s, 3]
        if z <= -radius:
            continue
        i0, i1, j0, j1 = 0, rows - 1, 0, columns - 1
        if z > radius:
            low, high = _tangents(x, z, radius)
            j0 = max(j0, math.floor((low - plane[0, 0]) / plane[1, 0]))
            j1 = min(j1, math.floor((high - plane[0, 0]) / plane[1, 0]))
            low, high = _tangents(y, z, radius)
            i0 = max(i0, math.floor((low - plane[0, 1]) / plane[1, 1]))
            i1 = min(i1, math.floor((high - plane[0, 1]) / plane[1, 1]))
        for i in range(int(i0), int(i1) + 1):
            for j in range(int(j0), int(j1) + 1):
                block = i * columns + j
                if ranges[block, 0] > z + radius or ranges[block, 1] < z - radius:
                    continue
                if _all_inside(depths, rays, first[block], first[block + 1], (x, y, z), radius, inside):
                    ranges[block, 0] = math.inf
