"""Voxels that a depth image shows to be free or occupied: each is looked up in the image, no ray is followed.

The image is given as :mod:`.depth_windows` has it. Numbers are of single precision.
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Bytes, Floats, Integers, Singles
from apex_ompl.kernel.compiled.perception.depth_windows import TILE, UNSEEN

FREE, UNKNOWN = -1, 0  # evidence of a voxel; above it the voxel is occupied
ENOUGH = 127  # number of points of a voxel that an image shows to be occupied
MOST_OF = 0.5  # share of the points to be expected that is enough where these are few
LEAST_DEPTH = 1e-3  # of what is looked up in the image [m]
BLOCK, PART = 8, 4  # voxels along a side of the blocks that are decided together, and of their parts
HIDDEN, PARTLY, IN_FRONT = -1, 0, 1

Box = tuple[int, int, int, int, int, int]
"""First voxel and that after the last along each axis."""
Spans = tuple[float, float, float]


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
    size = min(i1 - i0, j1 - j0)
    level = (size > 0) + (size > 2) + (size > 6) + (size > 14) + (size > 30)  # of LEVELS, without branches
    level = min(level, levels - 1)
    width = 1 << level
    i, j = i1 - width + 1, j1 - width + 1
    found = min(near[level, i0, j0], near[level, i0, j], near[level, i, j0], near[level, i, j])
    if max(i - i0, j - j0) > width:
        for a in range(i0, i1 + 1, width):
            for b in range(j0, j1 + 1, width):
                found = min(found, near[level, min(a, i), min(b, j)])
    return float(found)


@inlined
def _largest_depth(far: Singles, rows: int, columns: int, i0: float, i1: float, j0: float, j1: float) -> float:
    """Return the largest depth of the tiles that a rectangle of cells reaches into; UNSEEN outside of the image."""
    found = UNSEEN
    for i in range(int(max(i0, 0.0)) // TILE, int(min(i1, rows - 1.0)) // TILE + 1):
        for j in range(int(max(j0, 0.0)) // TILE, int(min(j1, columns - 1.0)) // TILE + 1):
            found = max(found, far[i, j])
    return found


@inlined
def _kind(
    near: Singles, far: Singles, lens: Floats, x: float, y: float, z: float, spans: Spans, thick: float,
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
        thick: Extent of a voxel along the optical axis [m].
    """
    shift = lens[8]
    front, back = z - spans[2], z + spans[2]
    if back < lens[4] or front > lens[5]:
        return HIDDEN
    if front - shift <= LEAST_DEPTH:
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
    if front + thick >= _largest_depth(far, rows, columns, i0, i1, j0, j1):
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
def _seen_through(near: Singles, center: Spans, half: float, lens: Floats) -> bool:
    """Return whether the cell at the center of a voxel is farther away than the voxel; ``half`` is its half depth."""
    (_, rows, columns), (x, y, z) = near.shape, center
    if z < lens[4] + half:
        return False
    u, v = (x / z - lens[0]) * lens[2], (y / z - lens[1]) * lens[3]
    return bool(0.0 <= u < columns and 0.0 <= v < rows and z + half < near[0, int(v), int(u)])


@inlined
def _windows(
    room: Singles, x: float, y: float, z: float, one: Spans, lens: Floats, shape: tuple[int, int]
) -> None:  # fmt: skip
    """Find the windows of the image around the voxels of a part, in a form that the compiler does many at a time.

    Args:
        room: Places of the voxels relative to the first (3 rows) [m]; gets the least and largest columns and rows of
            the windows (4 rows) [cells], and the depths that their cells must have more than [m], inf for windows that
            are not inside of the image, shape (8, PART^3).
        x: Center of the first voxel in the optical frame [m].
        y: As ``x``.
        z: As ``x``.
        one: Half the extents of a voxel along the axes of the optical frame [m].
        lens: See :func:`clear_voxels`.
        shape: Rows and columns of cells.
    """
    single = np.float32
    shift, hz, nearest, farthest = single(lens[8]), single(one[2]), single(lens[4]), single(lens[5])
    wide, high = single(one[0] + lens[8]), single(one[1] + lens[8])
    u_corner, v_corner, u_cells, v_cells = single(lens[0]), single(lens[1]), single(lens[2]), single(lens[3])
    factor, angle, half = single(1.0 + lens[6]), single(lens[7]), single(lens[9])
    rows, columns, least = single(shape[0]), single(shape[1]), single(LEAST_DEPTH)
    x_first, y_first, z_first = single(x), single(y), single(z)
    zero, unit, none = single(0.0), single(1.0), single(math.inf)
    for m in range(PART * PART * PART):
        across, down, depth = x_first + room[0, m], y_first + room[1, m], z_first + room[2, m]
        front, back = depth - hz, depth + hz
        low, far = unit / (front - shift), unit / (back + shift)
        a, b, c, d = across - wide, across + wide, down - high, down + high
        u0, u1 = min(a * low, a * far), max(b * low, b * far)
        v0, v1 = min(c * low, c * far), max(d * low, d * far)
        widest, highest = max(abs(u0), abs(u1)), max(abs(v0), abs(v1))
        turn = angle * (unit + widest * widest + highest * highest)
        u0, u1 = (u0 - turn - u_corner) * u_cells - half, (u1 + turn - u_corner) * u_cells + half
        v0, v1 = (v0 - turn - v_corner) * v_cells - half, (v1 + turn - v_corner) * v_cells + half
        seen = (front >= nearest) & (back <= farthest) & (front - shift > least)
        seen = seen & (u0 >= zero) & (v0 >= zero) & (u1 < columns) & (v1 < rows)
        room[3, m], room[4, m], room[5, m], room[6, m] = u0, u1, v0, v1
        room[7, m] = back * (factor + angle * (widest + highest)) + shift if seen else none


@inlined
def _clear_each(
    evidence: Bytes, hits: Bytes, near: Singles, pose: Floats, grid: Floats, lens: Floats, box: Box, one: Spans,
    room: Singles,
) -> None:  # fmt: skip
    """Clear the voxels of a part one by one, as :func:`_kind` says."""
    _, rows, columns = near.shape
    x, y, z = _middle(grid, pose, (box[0], box[0] + 1, box[2], box[2] + 1, box[4], box[4] + 1))
    _windows(room, x, y, z, one, lens, (rows, columns))
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            first = ((i - box[0]) * PART + j - box[2]) * PART - box[4]
            for k in range(box[4], box[5]):
                found, m = evidence[i, j, k], first + k
                if found <= FREE:
                    continue
                if found > UNKNOWN:
                    place = x + room[0, m], y + room[1, m], z + room[2, m]
                    if hits[i, j, k] != ENOUGH and _seen_through(near, place, one[2], lens):
                        evidence[i, j, k] = found - 1
                    continue
                reach = room[7, m]
                if reach == math.inf:
                    continue
                i0, i1, j0, j1 = int(room[5, m]), int(room[6, m]), int(room[3, m]), int(room[4, m])
                if reach < near[0, (i0 + i1) >> 1, (j0 + j1) >> 1] and reach < _least_depth(near, i0, i1, j0, j1):
                    evidence[i, j, k] = FREE


@inlined
def _busy(evidence: Bytes, box: Box) -> bool:
    """Return whether any voxel of a box is not FREE."""
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            for k in range(box[4], box[5]):
                if evidence[i, j, k] > FREE:
                    return True
    return False


@inlined
def _clear_parts(
    evidence: Bytes, hits: Bytes, near: Singles, far: Singles, pose: Floats, grid: Floats, lens: Floats, box: Box,
    one: Spans, room: Singles,
) -> None:  # fmt: skip
    """Clear the voxels of a box by parts of PART x PART x PART voxels, and one by one where a part is PARTLY in front.

    ``one`` has half the extents of a voxel along the axes of the optical frame [m].
    """
    spans = PART * one[0], PART * one[1], PART * one[2]
    for i in range(box[0], box[1], PART):
        for j in range(box[2], box[3], PART):
            for k in range(box[4], box[5], PART):
                part = i, min(i + PART, box[1]), j, min(j + PART, box[3]), k, min(k + PART, box[5])
                if not _busy(evidence, part):
                    continue
                x, y, z = _middle(grid, pose, part)
                kind = _kind(near, far, lens, x, y, z, spans, 2.0 * one[2])
                if kind == IN_FRONT:
                    _lower(evidence, hits, part)
                elif kind == PARTLY:
                    _clear_each(evidence, hits, near, pose, grid, lens, part, one, room)


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
    evidence: Bytes, hits: Bytes, near: Singles, far: Singles, pose: Floats, grid: Floats, lens: Floats, largest: Bytes,
    room: Singles,
) -> None:  # fmt: skip
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
        room: Room for numbers of the voxels of a part, shape (8, PART^3).
    """
    nx, ny, nz = evidence.shape
    for m in range(PART * PART * PART):
        i, j, k = m // (PART * PART), m // PART % PART, m % PART
        for axis in range(3):
            room[axis, m] = grid[3] * (i * pose[0, axis] + j * pose[1, axis] + k * pose[2, axis])
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
                kind = _kind(near, far, lens, x, y, z, many, 2.0 * hz)
                if kind == IN_FRONT:
                    start = k0 if start < 0 else start
                    continue
                if start >= 0:
                    _lower(evidence, hits, (i0, i1, j0, j1, start, k0))
                    start = -1
                if kind == HIDDEN:
                    continue
                _clear_parts(evidence, hits, near, far, pose, grid, lens, (i0, i1, j0, j1, k0, k1), one, room)
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
