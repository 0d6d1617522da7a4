"""Distances of points from a surface of triangles."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.grid_building import closest_squared
from apex_ompl.kernel.compiled.layout import Floats, Integers


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
