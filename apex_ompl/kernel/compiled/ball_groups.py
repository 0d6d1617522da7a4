"""Clearances of groups of balls from the obstacles of a scene, without a robot."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, GRID, SPHERE, SceneArrays, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.point_distance import estimate
from apex_ompl.kernel.compiled.scene_tree import next_obstacles
from apex_ompl.kernel.compiled.signed_distance import distance, primitive_distance


@inlined
def _lower_to(kind: int, balls: Floats, rotation: Floats, center: Floats, size: Floats, least: Floats) -> None:
    """Lower ``least``, shape (G,), to the signed distances of balls, shape (4, G), from a primitive [m].

    Its numbers are read before the loop, and its kind is to be a constant, so that several balls are taken at a time.
    """
    x, y, z, radius = balls[0], balls[1], balls[2], balls[3]
    r00, r10, r20 = rotation[0, 0], rotation[1, 0], rotation[2, 0]
    r01, r11, r21 = rotation[0, 1], rotation[1, 1], rotation[2, 1]
    r02, r12, r22 = rotation[0, 2], rotation[1, 2], rotation[2, 2]
    px, py, pz, sizes = center[0], center[1], center[2], (size[0], size[1], size[2])
    for n in range(len(least)):
        dx, dy, dz = x[n] - px, y[n] - py, z[n] - pz
        a = r00 * dx + r10 * dy + r20 * dz
        b = r01 * dx + r11 * dy + r21 * dz
        c = r02 * dx + r12 * dy + r22 * dz
        d = primitive_distance(kind, sizes, a, b, c) - radius[n]
        least[n] = d if d < least[n] else least[n]


@inlined
def lower_to_distances(s: SceneArrays, o: int, balls: Floats, least: Floats) -> None:
    """Lower ``least``, shape (G,), to the signed distances of balls, shape (4, G), from an obstacle [m]."""
    kind, rotation, center, size = s.kind[o], s.rotation[o], s.offset[o], s.size[o]
    if kind == BOX:
        _lower_to(BOX, balls, rotation, center, size, least)
    elif kind == CYLINDER:
        _lower_to(CYLINDER, balls, rotation, center, size, least)
    elif kind == CAPSULE:
        _lower_to(CAPSULE, balls, rotation, center, size, least)
    elif kind == SPHERE:
        _lower_to(SPHERE, balls, rotation, center, size, least)
    else:
        for n in range(len(least)):
            d = distance(s, o, balls[0, n], balls[1, n], balls[2, n]) - balls[3, n]
            least[n] = min(least[n], d)


@inlined
def _clearance(s: SceneArrays, seen: Integers, balls: Floats, best: float) -> float:
    """Return the least signed distance of balls behind one around them, shape (1 + M, 4) [m]; at most ``best``."""
    x, y, z, radius, k = balls[0, 0], balls[0, 1], balls[0, 2], balls[0, 3], 0
    while True:
        k, first, end = next_obstacles(s, x, y, z, max(best, 0.0) + radius, k)
        if first == end:
            return best
        for o in range(first, end):
            if not seen[o] or distance(s, o, x, y, z) - radius >= best:
                continue
            for m in range(1, len(balls)):
                u, v, w, r = balls[m, 0], balls[m, 1], balls[m, 2], balls[m, 3]
                d = distance(s, o, u, v, w)
                if s.kind[o] == GRID and d - r < best:
                    d = estimate(s, o, u, v, w, d)
                best = min(best, d - r)


@entry_point
def group_clearances(
    si: Integers, sf: Floats, sg: Singles, seen: Integers, outer: Floats, balls: Floats, limit: float, least: Floats,
    clearances: Floats,
) -> None:  # fmt: skip
    """Put the least signed distance of the balls of each group from the obstacles into ``clearances`` (G,) [m].

    Balls of clusters are looked at where the ball around them may be nearer than what was found, the nearest first.

    Args:
        si: Integers of the scene.
        sf: Floats of the scene.
        sg: Singles of the scene.
        seen: Which obstacles count, shape (obstacles,).
        outer: Centers and radii of the balls around clusters, shape (C, 4, G) [m].
        balls: Centers and radii, shape (G, C, 1 + M, 4) [m]: C clusters of a group with M balls each, behind a ball
            that contains these.
        limit: Larger clearances are given as this [m].
        least: Room, shape (C, G).
        clearances: Shape (G,) [m].
    """
    s = scene_view(si, sf, sg)
    for c in range(len(outer)):
        least[c] = limit
        for o in range(len(s.kind)):
            if seen[o]:
                lower_to_distances(s, o, outer[c], least[c])
    for g in range(len(balls)):
        best = limit
        while True:
            nearest, bound = -1, best
            for c in range(len(outer)):
                if least[c, g] < bound:
                    nearest, bound = c, least[c, g]
            if nearest < 0:
                break
            least[nearest, g] = math.inf
            best = _clearance(s, seen, balls[g, nearest], best)
        clearances[g] = best
