"""Distances tabulated on a grid (:mod:`apex_ompl.kernel.distance_grid`), and their gradients."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import inlined, outlined
from apex_ompl.kernel.compiled.layout import Integers, Singles

Place = tuple[int, float]

SLACK = math.sqrt(3.0) / 2.0  # largest error of interpolation, by which values at nodes are lowered, in spacings
LOWERED = 4.0 * SLACK  # by which they are lowered, at most
FARTHER, OPEN, NEARER = 1, 0, -1


@inlined
def _place(u: float, nodes: int) -> Place:
    """Return the cell of a coordinate that is on the grid, in spacings, and the share of the cell up to it."""
    cell = min(int(u), nodes - 2)
    return cell, u - cell


@outlined
def grid_distance(
    grid: Integers, values: Singles, spacing: float, a: float, b: float, c: float, enough: float
) -> float:  # fmt: skip
    """Return a lower bound of the distance of a point in the grid's frame [m].

    Outside of the grid, of which the solid is inside, it is the distance of two legs of a right-angled triangle: the
    one to the nearest point of the grid, and the one from there. Values at nodes hold up to half a cell's diagonal
    around them; where the one at the nearest node is ``enough``, it is taken as it is, without a look at the others.

    Args:
        grid: First value, and number of nodes along each axis, and more, shape (GRID_ROW,).
        values: Values of all grids.
        spacing: Of the nodes [m].
        a: Place of the point [m].
        b: The same.
        c: The same.
        enough: Bound that suffices [m]; infinite for the interpolated one.
    """
    nx, ny, nz = grid[1], grid[2], grid[3]
    scale = 1.0 / spacing
    a, b, c = a * scale, b * scale, c * scale
    x, y, z = min(max(a, 0.0), nx - 1.0), min(max(b, 0.0), ny - 1.0), min(max(c, 0.0), nz - 1.0)
    if not math.isfinite(a + b + c):
        return math.nan
    outside = (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2
    if outside > 0.0:
        if outside * spacing * spacing > enough * enough and enough > 0.0:
            return float(math.sqrt(outside) * spacing)
    else:
        nearest = values[grid[0] + (int(x + 0.5) * ny + int(y + 0.5)) * nz + int(z + 0.5)]
        if nearest > enough:
            return float(nearest)
    i, u = _place(x, nx)
    j, v = _place(y, ny)
    k, w = _place(z, nz)
    row, slab = nz, ny * nz
    n = grid[0] + (i * ny + j) * nz + k
    near = values[n : n + row + 2]
    far = values[n + slab : n + slab + row + 2]
    left = (near[0] * (1.0 - w) + near[1] * w) * (1.0 - v) + (near[row] * (1.0 - w) + near[row + 1] * w) * v
    right = (far[0] * (1.0 - w) + far[1] * w) * (1.0 - v) + (far[row] * (1.0 - w) + far[row + 1] * w) * v
    found = left * (1.0 - u) + right * u
    if outside > 0.0:
        return float(math.sqrt(outside * spacing * spacing + max(found, 0.0) ** 2))
    return float(found)


@outlined
def compare(grid: Integers, values: Singles, spacing: float, a: float, b: float, c: float, reach: float) -> int:
    """Compare the distance of a point in the grid's frame from what the grid is about with ``reach`` [m].

    A distance function is 1-Lipschitz: its value at the nearest node, before it was lowered, less the distance to that
    node is a bound. Mostly it is better than the interpolated one, and it needs no look at the other nodes.

    Args:
        grid: See :func:`grid_distance`.
        values: See there.
        spacing: Of the nodes [m].
        a: Place of the point [m].
        b: The same.
        c: The same.
        reach: The distance, which may be negative [m].

    Returns:
        FARTHER where that is proved, NEARER where it surely is not the case, else OPEN.
    """
    nx, ny, nz = grid[1], grid[2], grid[3]
    scale = 1.0 / spacing
    x, y, z = a * scale, b * scale, c * scale
    if 0.0 <= x <= nx - 1.0 and 0.0 <= y <= ny - 1.0 and 0.0 <= z <= nz - 1.0:
        i, j, k = int(x + 0.5), int(y + 0.5), int(z + 0.5)
        nearest = values[grid[0] + (i * ny + j) * nz + k]
        away = math.sqrt((x - i) ** 2 + (y - j) ** 2 + (z - k) ** 2)
        if nearest + spacing * (SLACK - away) > reach:
            return FARTHER
        if nearest + spacing * (LOWERED + away) < reach:
            return NEARER
    return FARTHER if grid_distance(grid, values, spacing, a, b, c, reach) > reach else OPEN


@outlined
def grid_direction(
    grid: Integers, values: Singles, spacing: float, a: float, b: float, c: float
) -> tuple[float, float, float]:
    """Return the gradient of :func:`grid_distance`, not of unit length; see there for the arguments."""
    nx, ny, nz = grid[1], grid[2], grid[3]
    a, b, c = a / spacing, b / spacing, c / spacing
    x, y, z = min(max(a, 0.0), nx - 1.0), min(max(b, 0.0), ny - 1.0), min(max(c, 0.0), nz - 1.0)
    if not math.isfinite(a + b + c):
        return math.nan, math.nan, math.nan
    i, u = _place(x, nx)
    j, v = _place(y, ny)
    k, w = _place(z, nz)
    n = grid[0] + (i * ny + j) * nz + k
    row, slab = nz, ny * nz
    dx, dy, dz, found = 0.0, 0.0, 0.0, 0.0
    for corner in range(8):
        p, q, r = corner // 4, corner // 2 % 2, corner % 2
        value = values[n + p * slab + q * row + r]
        along, across, up = (u if p else 1.0 - u), (v if q else 1.0 - v), (w if r else 1.0 - w)
        dx += (value if p else -value) * across * up
        dy += (value if q else -value) * along * up
        dz += (value if r else -value) * along * across
        found += value * along * across * up
    a, b, c = a - x, b - y, c - z
    if a * a + b * b + c * c > 0.0:
        share = max(found, 0.0) / spacing  # of the leg that is on the grid, where coordinates inside of it count
        dx, dy, dz = dx / spacing * share, dy / spacing * share, dz / spacing * share
        return (a if a != 0.0 else dx), (b if b != 0.0 else dy), (c if c != 0.0 else dz)
    return dx, dy, dz
