"""Voxels that a depth image shows to be free or occupied: each is looked up in the image, no ray is followed.

Pixels stand in the order of square blocks of the plane at depth 1 of the optical frame, so that distortion is no matter
here. Numbers are of single precision; sums are taken in the order in which they stand.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Bytes, Floats, Integers, Singles

FREE, UNKNOWN = -1, 0  # evidence of a voxel; above it the voxel is occupied
ENOUGH = 127  # number of points of a voxel that an image shows to be occupied
MOST_OF = 0.5  # share of the points to be expected that is enough where these are few
UNSEEN = 0.0  # depth of a block that is not known


@entry_point
def block_depths(
    depths: Singles, first: Integers, whole: Bytes, nearest: float, farthest: float, missing: float, near: Singles,
) -> None:  # fmt: skip
    """Find the least depth of each block, and those of the blocks around it.

    Args:
        depths: Depths of the pixels in the order of blocks, shape (P,) [m]; UNSEEN where there is none.
        first: First pixel of each block, and P, shape (rows columns + 1,).
        whole: Whether the image holds a block as a whole, shape (rows columns,).
        nearest: Smallest depth that counts [m].
        farthest: Depth up to which a larger one shows the space to be free [m].
        missing: Largest share of pixels without a depth in a block that is known.
        near: Gets the least depths of blocks, of 3x3 blocks around each, of 5x5 and so on, shape (levels, rows,
            columns) [m]; UNSEEN where one of them is not known, or outside of the image.
    """
    levels, rows, columns = near.shape
    for i in range(rows):
        for j in range(columns):
            block, lost, least = i * columns + j, 0, farthest
            for p in range(first[block], first[block + 1]):
                if depths[p] >= nearest:
                    least = min(least, depths[p])
                else:
                    lost += 1
            known = whole[block] != 0 and lost <= missing * (first[block + 1] - first[block])
            near[0, i, j] = least if known else UNSEEN
    for level in range(1, levels):
        before = near[level - 1]
        for i in range(rows):
            for j in range(columns):
                if i < level or j < level or i >= rows - level or j >= columns - level:
                    near[level, i, j] = UNSEEN
                    continue
                a = min(before[i - 1, j - 1], before[i - 1, j], before[i - 1, j + 1])
                b = min(before[i, j - 1], before[i, j], before[i, j + 1])
                c = min(before[i + 1, j - 1], before[i + 1, j], before[i + 1, j + 1])
                near[level, i, j] = min(a, b, c)


@inlined
def _tangents(across: float, along: float, radius: float) -> tuple[float, float]:
    """Return the least and the largest x / z of a circle about x = ``across``, z = ``along``, more than its radius."""
    square = across * across + along * along - radius * radius
    turn, bottom = radius * math.sqrt(square), along * along - radius * radius
    return (across * along - turn) / bottom, (across * along + turn) / bottom


@entry_point
def mark_inside(
    depths: Singles, rays: Singles, first: Integers, plane: Floats, columns: int, spheres: Floats, inside: Bytes
) -> None:
    """Mark the pixels whose points are inside of any sphere.

    Args:
        depths: Depths of the pixels in the order of blocks, shape (P,) [m].
        rays: Their points at depth 1, shape (P, 2).
        first: First pixel of each block, and P, shape (rows columns + 1,).
        plane: Corner of the first block and sides of a block at depth 1, shape (2, 2).
        columns: Columns of blocks.
        spheres: Centers in the optical frame and radii, shape (S, 4) [m].
        inside: Gets 1 for these pixels, shape (P,); 0 at the start.
    """
    rows = (len(first) - 1) // columns
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
                for p in range(first[block], first[block + 1]):
                    depth = depths[p]
                    if abs(depth - z) > radius or inside[p] != 0:
                        continue
                    a, b, c = rays[p, 0] * depth - x, rays[p, 1] * depth - y, depth - z
                    if a * a + b * b + c * c <= radius * radius:
                        inside[p] = 1


@entry_point
def fill_voxels(
    evidence: Bytes, hits: Bytes, depths: Singles, rays: Singles, inside: Bytes, nearest: float, farthest: float,
    pose: Floats, origin: Floats, side: float, dense: float, sharp: float, share: float, least: float, gain: int,
    most: int,
) -> None:  # fmt: skip
    """Raise the evidence of voxels that hold enough points of an image.

    A surface across the line of sight at a depth z leaves ``dense`` / z^2 points in a voxel, or, where its noise is
    larger than the voxel, ``sharp`` / z^2 of these. A share of that many is enough, and at least ``least``, or MOST_OF
    those that are to be expected.

    Args:
        evidence: FREE, UNKNOWN or more for occupied voxels, shape (nx, ny, nz).
        hits: Gets how many points each voxel holds, ENOUGH where they are enough; 0 at the start.
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
        depth = depths[p]
        if not nearest <= depth <= farthest or inside[p] != 0:
            continue
        a, b = rays[p, 0] * depth, rays[p, 1] * depth
        x = (pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * depth + x0) * scale
        y = (pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * depth + y0) * scale
        z = (pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * depth + z0) * scale
        if not (0.0 <= x < nx and 0.0 <= y < ny and 0.0 <= z < nz):
            continue
        i, j, k = int(x), int(y), int(z)
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


@inlined
def _narrowed(low: float, high: float, start: float, step: float) -> tuple[float, float]:
    """Return where start + step t >= 0 holds in a range of t; an empty range where it does not."""
    if step > 0.0:
        return max(low, -start / step), high
    if step < 0.0:
        return low, min(high, -start / step)
    return low, (high if start >= 0.0 else low - 1.0)


@entry_point
def clear_voxels(
    evidence: Bytes, hits: Bytes, near: Singles, plane: Floats, pose: Floats, origin: Floats, side: float,
    nearest: float, farthest: float, stretch: float, reach: float, half: float, radius: float,
    margin: float,
) -> None:  # fmt: skip
    """Lower the evidence of voxels that are in front of all surfaces which the image shows where they appear.

    A voxel that holds no points becomes FREE step by step where it is in front of all depths in the window of blocks
    that contains its image. Elsewhere the evidence of an occupied voxel goes down to UNKNOWN where the block at its
    center is farther away than the voxel.

    Args:
        evidence: FREE, UNKNOWN or more for occupied voxels, shape (nx, ny, nz).
        hits: How many points each voxel holds, by :func:`fill_voxels`.
        near: Least depths by :func:`block_depths`, shape (levels, rows, columns) [m].
        plane: Corner of the first block and sides of a block at depth 1, shape (2, 2).
        pose: Pose of the optical frame, shape (4, 4) [m].
        origin: Outer corner of the first voxel, shape (3,) [m].
        side: Side of a voxel [m].
        nearest: Smallest depth of a center, more than ``half`` [m].
        farthest: Largest depth of a center [m].
        stretch: Factor of a center's depth by its largest relative error.
        reach: Depth beyond it that must be free, too [m].
        half: Half the extent of a voxel along the optical axis [m].
        radius: Half the extent of a voxel's image, times depth less ``half`` [blocks m].
        margin: What is added to that [blocks].
    """
    nx, ny, nz = evidence.shape
    levels, rows, columns = near.shape
    u0, v0, su, sv = plane[0, 0], plane[0, 1], 1.0 / plane[1, 0], 1.0 / plane[1, 1]
    u1, v1 = u0 + columns * plane[1, 0], v0 + rows * plane[1, 1]
    dx, dy, dz = pose[2, 0] * side, pose[2, 1] * side, pose[2, 2] * side
    for i in range(nx):
        for j in range(ny):
            a, b = origin[0] + (i + 0.5) * side - pose[0, 3], origin[1] + (j + 0.5) * side - pose[1, 3]
            c = origin[2] + 0.5 * side - pose[2, 3]
            x = pose[0, 0] * a + pose[1, 0] * b + pose[2, 0] * c
            y = pose[0, 1] * a + pose[1, 1] * b + pose[2, 1] * c
            z = pose[0, 2] * a + pose[1, 2] * b + pose[2, 2] * c
            low, high = _narrowed(0.0, nz - 1.0, z - nearest, dz)
            low, high = _narrowed(low, high, farthest - z, -dz)
            low, high = _narrowed(low, high, x - u0 * z, dx - u0 * dz)
            low, high = _narrowed(low, high, u1 * z - x, u1 * dz - dx)
            low, high = _narrowed(low, high, y - v0 * z, dy - v0 * dz)
            low, high = _narrowed(low, high, v1 * z - y, v1 * dz - dy)
            if not low <= high:
                continue
            for k in range(int(math.ceil(low)), int(math.floor(high)) + 1):
                found = evidence[i, j, k]
                if found <= FREE or hits[i, j, k] == ENOUGH:
                    continue
                depth = z + k * dz
                inverse = 1.0 / depth
                column = min(max(int(((x + k * dx) * inverse - u0) * su), 0), columns - 1)
                row = min(max(int(((y + k * dy) * inverse - v0) * sv), 0), rows - 1)
                level = int(radius / (depth - half) + margin) + 1
                if level < levels and depth * stretch + reach < near[level, row, column]:
                    evidence[i, j, k] = found - 1
                elif found > UNKNOWN and depth + half < near[0, row, column]:
                    evidence[i, j, k] = found - 1


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
