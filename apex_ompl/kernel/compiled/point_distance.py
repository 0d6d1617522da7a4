"""Signed distances of points and of groups of balls from the nearest obstacle of a scene, without a robot.

Both leave out obstacles that are not ``seen``, shape (obstacles,), for example a robot's fixtures.
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import SceneArrays, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.scene_tree import next_obstacles
from apex_ompl.kernel.compiled.signed_distance import direction, distance


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
                if d < best:
                    best, nearest = d, o


@entry_point
def nearest_points(
    si: Integers, sf: Floats, sg: Singles, seen: Integers, points: Floats, limit: float, distances: Floats,
    gradients: Floats,
) -> None:  # fmt: skip
    """Put the signed distances of points, shape (N, 3) [m], from the nearest obstacle into ``distances`` (N,) [m].

    Distances above ``limit`` are given as ``limit``. ``gradients``, shape (N, 3), gets the gradients: unit vectors, but
    for grids nearly so, and 0 at the limit.
    """
    s = scene_view(si, sf, sg)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        distances[k], o = _nearest(s, seen, x, y, z, limit)
        gradients[k, 0] = gradients[k, 1] = gradients[k, 2] = 0.0
        if o >= 0:
            gradients[k, 0], gradients[k, 1], gradients[k, 2] = direction(s, o, x, y, z)


@entry_point
def group_clearances(
    si: Integers, sf: Floats, sg: Singles, seen: Integers, balls: Floats, limit: float, clearances: Floats
) -> None:
    """Put the least signed distance of the balls of each group from the obstacles into ``clearances`` (G,) [m].

    Args:
        si: Integers of the scene.
        sf: Floats of the scene.
        sg: Singles of the scene.
        seen: Which obstacles count, shape (obstacles,).
        balls: Centres and radii, shape (G, C, 1 + M, 4) [m]: C clusters of a group with M balls each, behind a ball
            that contains these, which is looked at first.
        limit: Larger clearances are given as this [m].
        clearances: Shape (G,) [m].
    """
    s = scene_view(si, sf, sg)
    for g in range(len(balls)):
        best = limit
        for c in range(balls.shape[1]):
            outer = balls[g, c, 0]
            if _nearest(s, seen, outer[0], outer[1], outer[2], best + outer[3])[1] < 0:
                continue
            for m in range(1, balls.shape[2]):
                ball = balls[g, c, m]
                found = _nearest(s, seen, ball[0], ball[1], ball[2], best + ball[3])[0] - ball[3]
                best = min(best, found)
        clearances[g] = best
