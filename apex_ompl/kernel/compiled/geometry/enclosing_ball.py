"""A small ball around balls that move, by steps towards the farthest one (Badoiu and Clarkson 2003)."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.layout import Floats, Integers

STEPS = 99


@entry_point
def enclose(points: Floats, counted: Integers, radii: Floats, center: Floats, away: Floats) -> None:
    """Find a center near that of the smallest ball around balls in all their places.

    Args:
        points: Centers of n balls in N places, shape (N, n, 3) [m].
        counted: Numbers of the balls that are to be enclosed, shape (m,).
        radii: Their radii, shape (m,) [m].
        center: Gets the center, shape (3,) [m].
        away: Gets the largest distance of each of the n centers from it, shape (n,) [m].
    """
    places, balls, many = points.shape[0], points.shape[1], len(counted)
    for i in range(3):
        center[i] = 0.0
        for s in range(places):
            for k in range(many):
                center[i] += points[s, counted[k], i]
        center[i] /= max(places * many, 1)
    for step in range(1, STEPS + 1):
        farthest, place, ball = -1.0, 0, 0
        for s in range(places):
            for k in range(many):
                p = points[s, counted[k]]
                x, y, z = p[0] - center[0], p[1] - center[1], p[2] - center[2]
                reach = math.sqrt(x * x + y * y + z * z) + radii[k]
                if reach > farthest:
                    farthest, place, ball = reach, s, k
        long = farthest - radii[ball]
        if farthest < 0.0 or long <= 0.0:
            break
        p, share = points[place, counted[ball]], 0.5 * farthest / long / (step + 1.0)
        for i in range(3):
            center[i] += share * (p[i] - center[i])
    for k in range(balls):
        away[k] = 0.0
        for s in range(places):
            p = points[s, k]
            x, y, z = p[0] - center[0], p[1] - center[1], p[2] - center[2]
            away[k] = max(away[k], x * x + y * y + z * z)
        away[k] = math.sqrt(away[k])
