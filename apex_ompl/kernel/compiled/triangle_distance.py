"""Distances of points from triangles."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers

Corner = Floats | tuple[float, float, float]


@inlined
def squared_distance(a: Corner, b: Corner, c: Corner, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point to a triangle with given corners, shape (3,) (Ericson 2005, 5.1.5)."""
    ax, ay, az = a[0], a[1], a[2]
    ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
    vx, vy, vz = c[0] - ax, c[1] - ay, c[2] - az
    px, py, pz = x - ax, y - ay, z - az
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    d3, d4, d5, d6 = d1 - uu, d2 - uv, d1 - uv, d2 - vv
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        s, r = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        s, r = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        s, r = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, r = d1 / (d1 - d3) if d1 > d3 else 0.0, 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s, r = 0.0, d2 / (d2 - d6) if d2 > d6 else 0.0
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        r = (d4 - d3) / ((d4 - d3) + (d5 - d6)) if d4 - d3 + d5 - d6 > 0.0 else 0.0
        s = 1.0 - r
    else:
        whole = va + vb + vc
        s, r = vb / whole, vc / whole
    dx, dy, dz = px - s * ux - r * vx, py - s * uy - r * vy, pz - s * uz - r * vz
    squared: float = dx * dx + dy * dy + dz * dz
    return squared


@inlined
def closest_squared(corners: Floats, t: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point to triangle ``t``."""
    return squared_distance(corners[t, 0], corners[t, 1], corners[t, 2], x, y, z)


@entry_point
def surface_distances(
    points: Floats, corners: Floats, balls: Floats, child: Integers, leaf: Integers, stack: Integers, limit: float,
    distances: Floats,
) -> None:  # fmt: skip
    """Put the distances of points from the nearest triangle into place, at most a limit.

    Args:
        points: Shape (N, 3) [m].
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        balls: Nodes of a tree over them, see :func:`apex_ompl.collision.exact_shapes.ball_tree`, shape (n, 4) [m].
        child: First child of each node, shape (n,).
        leaf: Triangle of each leaf, shape (n,).
        stack: Room, longer than the tree is deep.
        limit: Largest distance of interest [m].
        distances: Shape (N,) [m].
    """
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best, top = limit, 1
        stack[0] = 0
        while top > 0:
            top -= 1
            n = stack[top]
            apart = math.sqrt((x - balls[n, 0]) ** 2 + (y - balls[n, 1]) ** 2 + (z - balls[n, 2]) ** 2) - balls[n, 3]
            if apart >= best:
                continue
            if child[n] < 0:
                best = min(best, math.sqrt(closest_squared(corners, leaf[n], x, y, z)))
            else:
                stack[top], stack[top + 1] = child[n], child[n] + 1
                top += 2
        distances[p] = best
