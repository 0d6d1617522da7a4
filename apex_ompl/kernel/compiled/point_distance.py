"""Signed distances of points from the nearest obstacle of a scene, without a robot.

They leave out obstacles that are not ``seen``, shape (obstacles,), for example a robot's fixtures. Distances of grids
are bounds elsewhere; here they are estimates, near to what those of the same solid as a primitive are.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import GRID, SceneArrays, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.scene_tree import next_obstacles
from apex_ompl.kernel.compiled.signed_distance import direction, distance, local_point


@inlined
def _surface_point(s: SceneArrays, o: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the point of a grid's surface that is nearest to the grid's nearest point to (x, y, z); it may be that.

    A point that is on the grid itself is returned as it is.
    """
    a, b, c = local_point(s, o, x, y, z)
    r, p, spacing, nodes = s.rotation[o], s.offset[o], s.size[o, 0], s.grid[o]
    u = min(max(a, 0.0), (nodes[1] - 1) * spacing)
    v = min(max(b, 0.0), (nodes[2] - 1) * spacing)
    w = min(max(c, 0.0), (nodes[3] - 1) * spacing)
    if u == a and v == b and w == c:
        return x, y, z
    x = p[0] + r[0, 0] * u + r[0, 1] * v + r[0, 2] * w
    y = p[1] + r[1, 0] * u + r[1, 1] * v + r[1, 2] * w
    z = p[2] + r[2, 0] * u + r[2, 1] * v + r[2, 2] * w
    d, n = distance(s, o, x, y, z) + s.size[o, 1], direction(s, o, x, y, z)
    return x - d * n[0], y - d * n[1], z - d * n[2]


@outlined
def estimate(s: SceneArrays, o: int, x: float, y: float, z: float, bound: float) -> float:
    """Return the signed distance of a point from a grid's solid [m], of which ``bound`` is a lower bound.

    On the grid it is as it was found, not lowered. Elsewhere it is that of the surface's point nearest to the grid's
    nearest point.
    """
    u, v, w = _surface_point(s, o, x, y, z)
    apart = math.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2)
    return apart if apart > 0.0 else bound + s.size[o, 1]


@inlined
def _gradient(s: SceneArrays, o: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the gradient of the signed distance of a point from an obstacle, a unit vector."""
    if s.kind[o] == GRID:
        u, v, w = _surface_point(s, o, x, y, z)
        apart = math.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2)
        if apart > 0.0:
            return (x - u) / apart, (y - v) / apart, (z - w) / apart
    return direction(s, o, x, y, z)


@inlined
def _nearest(s: SceneArrays, seen: Integers, x: float, y: float, z: float, limit: float) -> tuple[float, int]:
    """Return the signed distance of a point from the nearest obstacle [m], and which; ``limit`` and -1 beyond it."""
    best, nearest, k = limit, -1, 0
    while True:
        k, first, end = next_obstacles(s, x, y, z, max(best, 0.0), k)
        if first == end:
            return best, nearest
        for o in range(first, end):
            if seen[o]:
                d = distance(s, o, x, y, z)
                if s.kind[o] == GRID and d < best:
                    d = estimate(s, o, x, y, z, d)
                if d < best:
                    best, nearest = d, o


@entry_point
def nearest_points(
    si: Integers, sf: Floats, sg: Singles, seen: Integers, points: Floats, limit: float, distances: Floats,
    gradients: Floats,
) -> None:  # fmt: skip
    """Put the signed distances of points, shape (N, 3) [m], from the nearest obstacle into ``distances`` (N,) [m].

    Distances above ``limit`` are given as ``limit``. ``gradients``, shape (N, 3), gets the gradients: unit vectors,
    and 0 at the limit.
    """
    s = scene_view(si, sf, sg)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        distances[k], o = _nearest(s, seen, x, y, z, limit)
        gradients[k, 0] = gradients[k, 1] = gradients[k, 2] = 0.0
        if o >= 0:
            gradients[k, 0], gradients[k, 1], gradients[k, 2] = _gradient(s, o, x, y, z)
