"""Voxels that a depth image shows to be free or occupied: each is looked up in the image, no ray is followed.

Pixels stand in the order of square blocks of the plane at depth 1 of the optical frame, so that distortion is no matter
here. Numbers are of single precision; sums are taken in the order in which they stand.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Bytes, Floats, Integers, Singles

FREE, UNKNOWN = -1, 0  # evidence of a voxel; above it the voxel is occupied
ENOUGH = 127  # number of points of a voxel that an image shows to be occupied
MOST_OF = 0.5  # share of the points to be expected that is enough where these are few
UNSEEN = 0.0  # depth of a cell that is not known
TILE = 8  # cells along a side of the tiles whose largest depths are kept
BLOCK = 8  # voxels along a side of the blocks that are decided together
HIDDEN, PARTLY, IN_FRONT = -1, 0, 1

Box = tuple[int, int, int, int, int, int]
"""First voxel and that after the last along each axis."""
Spans = tuple[float, float, float]


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
            for a in range(max(v - 1, 0), min(v + 2, height)):
                for b in range(max(u - 1, 0), min(u + 2, width)):
                    if abs(image[a, b] - depth) <= limit:
                        count += 1
            found[i, j] = depth if count > least else UNSEEN


@inlined
def _tangents(across: float, along: float, radius: float) -> tuple[float, float]:
    """Return the least and the largest x / z of a circle about x = ``across``, z = ``along``, more than its radius."""
    square = across * across + along * along - radius * radius
    turn, bottom = radius * math.sqrt(square), along * along - radius * radius
    return (across * along - turn) / bottom, (across * along + turn) / bottom


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
        ranges: Gets the least and the largest depth of each block, shape (rows columns, 2) [m].
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
                for p in range(first[block], first[block + 1]):
                    depth = depths[p]
                    if abs(depth - z) > radius or inside[p] != 0:
                        continue
                    a, b, c = rays[p, 0] * depth - x, rays[p, 1] * depth - y, depth - z
                    if a * a + b * b + c * c <= radius * radius:
                        inside[p] = 1


@entry_point
def fill_voxels(
    evidence: Bytes, hits: Bytes, cells: Integers, depths: Singles, rays: Singles, inside: Bytes, nearest: float,
    farthest: float, pose: Floats, origin: Floats, side: float, dense: float, sharp: float, share: float, least: float,
    gain: int, most: int,
) -> None:  # fmt: skip
    """Raise the evidence of voxels that hold enough points of an image.

    A surface across the line of sight at a depth z leaves ``dense`` / z^2 points in a voxel, or, where its noise is
    larger than the voxel, ``sharp`` / z^2 of these. A share of that many is enough, and at least ``least``, or MOST_OF
    those that are to be expected.

    Args:
        evidence: FREE, UNKNOWN or more for occupied voxels, shape (nx, ny, nz).
        hits: Gets how many points each voxel holds, ENOUGH where they are enough; 0 at the start.
        cells: Gets the number of the voxel that holds each point, -1 for none, shape (P,).
        depths: Depths of the pixels, shape (P,) [m]; UNSEEN or less where there is none.
        rays: Their points at depth 1, shape (P, 2).
        inside: Pixels that are left out, shape (P,).
        nearest: Smallest depth that counts [m].
        farthest: Largest depth that counts [m].
        pose: Pose of the optical frame, shape (4, 4) [m].
        origin: Outer corner of the first voxel, shape (3,) [m].
        side: Side of a voxel [m].
        dense: Points in the area of a voxel's side at 1 m [m^2].
        sharp: Side of a voxel over the extent of the noise at 1 m [m^2].
        share: The share.
        least: How many points are the least, where more are to be expected.
        gain: What they add to a voxel's evidence, which is UNKNOWN at least before.
        most: Largest evidence.
    """
    nx, ny, nz = evidence.shape
    scale = 1.0 / side
    x0, y0, z0 = pose[0, 3] - origin[0], pose[1, 3] - origin[1], pose[2, 3] - origin[2]
    for p in range(len(depths)):
        depth, cells[p] = depths[p], -1
        if not nearest <= depth <= farthest or inside[p] != 0:
            continue
        a, b = rays[p, 0] * depth, rays[p, 1] * depth
        x = (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * depth + x0) * scale
        y = (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * depth + y0) * scale
        z = (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * depth + z0) * scale
        if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
            continue
        i, j, k = int(x), int(y), int(z)
        cells[p] = (i * ny + j) * nz + k
        found = hits[i, j, k]
        if found == ENOUGH:
            continue
        over = 1.0 / (depth * depth)
        expected = dense * over * min(1.0, sharp * over)
        found += 1
        if found == ENOUGH or found >= max(share * expected, min(least, MOST_OF * expected)):
            evidence[i, j, k] = min(max(evidence[i, j, k], UNKNOWN) + gain, most)
            found = ENOUGH
        hits[i, j, k] = found


@entry_point
def forget_hits(hits: Bytes, cells: Integers) -> None:
    """Set how many points voxels hold to 0, by the numbers that :func:`fill_voxels` gave, shape (P,)."""
    _, ny, nz = hits.shape
    for p in range(len(cells)):
        if cells[p] >= 0:
            row = cells[p] // nz
            hits[row // ny, row % ny, cells[p] % nz] = 0


@inlined
def _quotients(across: float, half: float, near: float, far: float) -> tuple[float, float]:
    """Return the least and the largest x / z of a box of half extent ``half`` in x; ``near`` and ``far`` are 1 / z."""
    a, b = across - half, across + half
    return a * (near if a < 0.0 else far), b * (near if b > 0.0 else far)


@inlined
def _least_depth(near: Singles, i0: int, i1: int, j0: int, j1: int) -> float:
    """Return the least depth of the cells of a rectangle, UNSEEN where one is not known or outside of the image."""
    levels, rows, columns = near.shape
    if i0 < 0 or j0 < 0 or i1 >= rows or j1 >= columns:
        return UNSEEN
    size, level = min(i1 - i0, j1 - j0) + 1, 0
    while 2 << level <= size:
        level += 1
    width = 1 << level
    i, j = i1 - width + 1, j1 - width + 1
    found = min(near[level, i0, j0], near[level, i0, j], near[level, i, j0], near[level, i, j])
    if max(i - i0, j - j0) > width:
        for a in range(i0, i1 + 1, width):
            for b in range(j0, j1 + 1, width):
                found = min(found, near[level, min(a, i), min(b, j)])
    return float(found)


@inlined
def _largest_depth(far: Singles, rows: int, columns: int, i0: int, i1: int, j0: int, j1: int) -> float:
    """Return the largest depth of the tiles that a rectangle of cells reaches into; UNSEEN outside of the image."""
    found = UNSEEN
    for i in range(max(i0, 0) // TILE, min(i1, rows - 1) // TILE + 1):
        for j in range(max(j0, 0) // TILE, min(j1, columns - 1) // TILE + 1):
            found = max(found, far[i, j])
    return found


@inlined
def _kind(
    near: Singles, far: Singles, lens: Floats, x: float, y: float, z: float, spans: Spans, block: bool,
) -> int:  # fmt: skip
    """Return whether a box is IN_FRONT of all surfaces around it, or HIDDEN: behind them all, or outside of the image.

    Args:
        near: Least depths by :func:`cell_depths`, shape (levels, rows, columns) [m].
        far: Largest depths.
        lens: See :func:`clear_voxels`.
        x: Center of the box in the optical frame [m].
        y: As ``x``.
        z: As ``x``.
        spans: Half the extents of the box along the axes of the optical frame [m].
        block: Whether HIDDEN is to be told from PARTLY.
    """
    shift = lens[8]
    front, back = z - spans[2], z + spans[2]
    if block and (back < lens[4] or front > lens[5]):
        return HIDDEN
    if front - shift <= 1e-3:
        return PARTLY
    low, high = 1.0 / (front - shift), 1.0 / (back + shift)
    u0, u1 = _quotients(x, spans[0] + shift, low, high)
    v0, v1 = _quotients(y, spans[1] + shift, low, high)
    widest, highest = max(abs(u0), abs(u1)), max(abs(v0), abs(v1))
    turn = lens[7] * (1.0 + widest * widest + highest * highest)
    rows, columns = near.shape[1], near.shape[2]
    j0, j1 = (u0 - turn - lens[0]) * lens[2] - lens[9], (u1 + turn - lens[0]) * lens[2] + lens[9]
    i0, i1 = (v0 - turn - lens[1]) * lens[3] - lens[9], (v1 + turn - lens[1]) * lens[3] + lens[9]
    if i1 < 0.0 or j1 < 0.0 or i0 >= rows or j0 >= columns:
        return HIDDEN
    if i0 >= 0.0 and j0 >= 0.0 and i1 < rows and j1 < columns and front >= lens[4] and back <= lens[5]:
        reach = back * (1.0 + lens[6] + lens[7] * (widest + highest)) + shift
        if reach < _least_depth(near, int(i0), int(i1), int(j0), int(j1)):
            return IN_FRONT
    if block:
        a, b = max(i0, 0.0), max(j0, 0.0)
        i, j = min(i1, rows - 1.0), min(j1, columns - 1.0)
        if front >= _largest_depth(far, rows, columns, int(a), int(i), int(b), int(j)):
            return HIDDEN
    return PARTLY


@inlined
def _lower(evidence: Bytes, hits: Bytes, box: Box) -> None:
    """Lower the evidence of the voxels of a box that hold too few points; not below FREE."""
    free, enough = np.int8(FREE), np.int8(ENOUGH)
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            row, counts = evidence[i, j, box[4] : box[5]], hits[i, j, box[4] : box[5]]
            for k in range(len(row)):  # in a form that the compiler turns into instructions on many numbers
                row[k] = np.int8(row[k] - ((row[k] > free) & (counts[k] != enough)))


@inlined
def _middle(grid: Floats, pose: Floats, box: Box) -> tuple[float, float, float]:
    """Return the center of a box of voxels in the optical frame [m]."""
    a = grid[0] + 0.5 * (box[0] + box[1]) * grid[3] - pose[0, 3]
    b = grid[1] + 0.5 * (box[2] + box[3]) * grid[3] - pose[1, 3]
    c = grid[2] + 0.5 * (box[4] + box[5]) * grid[3] - pose[2, 3]
    x = pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c
    y = pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c
    return x, y, pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c


@inlined
def _clear_each(
    evidence: Bytes, hits: Bytes, near: Singles, far: Singles, pose: Floats, grid: Floats, lens: Floats, box: Box,
    spans: Spans,
) -> None:  # fmt: skip
    """Clear the voxels of a box one by one."""
    rows, columns, hz, side = near.shape[1], near.shape[2], spans[2], grid[3]
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            x, y, z = _middle(grid, pose, (i, i + 1, j, j + 1, box[4], box[4] + 1))
            for k in range(box[4], box[5]):
                found = evidence[i, j, k]
                if found <= FREE or hits[i, j, k] == ENOUGH:
                    continue
                step = (k - box[4]) * side
                depth = z + step * pose[2, 2]
                if depth < lens[4] + hz:
                    continue
                across, down, inverse = x + step * pose[2, 0], y + step * pose[2, 1], 1.0 / depth
                u, v = (across * inverse - lens[0]) * lens[2], (down * inverse - lens[1]) * lens[3]
                if not (0.0 <= u < columns and 0.0 <= v < rows and depth + hz < near[0, int(v), int(u)]):
                    continue  # neither condition can hold
                if found > UNKNOWN or _kind(near, far, lens, across, down, depth, spans, False) == IN_FRONT:
                    evidence[i, j, k] = found - 1


@inlined
def _largest(evidence: Bytes, i0: int, i1: int, j0: int, j1: int, found: Bytes) -> None:
    """Find the largest evidence of voxels of a column at each height, shape (nz,)."""
    for k in range(len(found)):
        found[k] = FREE
    for i in range(i0, i1):
        for j in range(j0, j1):
            row = evidence[i, j, : len(found)]
            for k in range(len(found)):
                found[k] = max(found[k], row[k])


@entry_point
def clear_voxels(
    evidence: Bytes, hits: Bytes, near: Singles, far: Singles, pose: Floats, grid: Floats, lens: Floats, largest: Bytes
) -> None:
    """Lower the evidence of voxels that are in front of all surfaces which the image shows where they appear.

    A voxel that holds no points becomes FREE step by step where it is in front of all depths of the cells that its
    image touches, by the errors of the camera. Elsewhere the evidence of an occupied voxel goes down to UNKNOWN where
    the cell at its center is farther away than the voxel. Blocks of voxels are decided together where they can be.

    Args:
        evidence: FREE, UNKNOWN or more for occupied voxels, shape (nx, ny, nz).
        hits: How many points each voxel holds, by :func:`fill_voxels`.
        near: Least depths by :func:`cell_depths`, shape (levels, rows, columns) [m].
        far: Largest depths.
        pose: Pose of the optical frame, shape (4, 4) [m].
        grid: Outer corner of the first voxel (3), and side of a voxel [m].
        lens: Corner of the first cell at depth 1 (2) and cells in a unit there (2); smallest depth of what becomes
            free, and the largest [m]; relative error of depths; errors of the camera's orientation [rad] and
            position [m]; half a pixel [cells].
        largest: Room for numbers of voxels along the last axis, shape (nz,).
    """
    nx, ny, nz = evidence.shape
    half = 0.5 * grid[3]
    hx = half * (abs(pose[0, 0]) + abs(pose[1, 0]) + abs(pose[2, 0]))
    hy = half * (abs(pose[0, 1]) + abs(pose[1, 1]) + abs(pose[2, 1]))
    hz = half * (abs(pose[0, 2]) + abs(pose[1, 2]) + abs(pose[2, 2]))
    one = hx, hy, hz
    many = BLOCK * hx, BLOCK * hy, BLOCK * hz
    for i0 in range(0, nx, BLOCK):
        for j0 in range(0, ny, BLOCK):
            i1, j1, start = min(i0 + BLOCK, nx), min(j0 + BLOCK, ny), -1
            _largest(evidence, i0, i1, j0, j1, largest)
            for k0 in range(0, nz, BLOCK):
                k1, busy = min(k0 + BLOCK, nz), False
                for k in range(k0, k1):
                    busy = busy or largest[k] > FREE
                if not busy:
                    continue
                x, y, z = _middle(grid, pose, (i0, i1, j0, j1, k0, k1))
                kind = _kind(near, far, lens, x, y, z, many, True)
                if kind == IN_FRONT:
                    start = k0 if start < 0 else start
                    continue
                if start >= 0:
                    _lower(evidence, hits, (i0, i1, j0, j1, start, k0))
                    start = -1
                if kind == HIDDEN:
                    continue
                _clear_each(evidence, hits, near, far, pose, grid, lens, (i0, i1, j0, j1, k0, k1), one)
            if start >= 0:
                _lower(evidence, hits, (i0, i1, j0, j1, start, nz))


@entry_point
def mark_near(flags: Bytes, spheres: Floats, origin: Floats, side: float) -> None:
    """Mark the voxels whose centers are inside of any sphere.

    Args:
        flags: Gets 1 for these, shape (nx, ny, nz).
        spheres: Centers and radii, shape (S, 4) [m].
        origin: Outer corner of the first voxel, shape (3,) [m].
        side: Side of a voxel [m].
    """
    nx, ny, nz = flags.shape
    for s in range(len(spheres)):
        r = spheres[s, 3] / side
        x, y = (spheres[s, 0] - origin[0]) / side - 0.5, (spheres[s, 1] - origin[1]) / side - 0.5
        z = (spheres[s, 2] - origin[2]) / side - 0.5
        for i in range(max(0, int(math.ceil(x - r))), min(nx - 1, int(math.floor(x + r))) + 1):
            for j in range(max(0, int(math.ceil(y - r))), min(ny - 1, int(math.floor(y + r))) + 1):
                for k in range(max(0, int(math.ceil(z - r))), min(nz - 1, int(math.floor(z + r))) + 1):
                    if (i - x) * (i - x) + (j - y) * (j - y) + (k - z) * (k - z) <= r * r:
                        flags[i, j, k] = 1
