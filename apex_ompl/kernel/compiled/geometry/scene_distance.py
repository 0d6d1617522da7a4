"""Signed distances of points and groups of balls from the obstacles of one scene or many, without a robot.

Obstacles of one scene that are not ``seen``, shape (obstacles,), are left out, for example a robot's fixtures.
Distances of grids are bounds elsewhere; here they are estimates, close to those of the same solid as a primitive.

A batch of scenes has no tree over its obstacles: each scene owns a contiguous range of them. Of its arrays, packed as
:class:`.SceneArrays`, only kinds, places and sizes are filled in.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, GRID, SPHERE, SceneArrays, scene_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.geometry.signed_distance import (
    direction,
    distance,
    local_point,
    next_obstacles,
    primitive_distance,
)
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles


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
    """Return the least signed distance of balls that follow one around them, shape (1 + M, 4) [m]; at most ``best``."""
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

    Balls of clusters are examined where the ball around them may be nearer than what was found, the nearest first.

    Args:
        si: Integers of the scene.
        sf: Floats of the scene.
        sg: Singles of the scene.
        seen: Which obstacles count, shape (obstacles,).
        outer: Centers and radii of the balls around clusters, shape (C, 4, G) [m].
        balls: Centers and radii, shape (G, C, 1 + M, 4) [m]: C clusters of a group with M balls each, after a ball
            that contains these.
        limit: Larger clearances are given as this [m].
        least: Buffer, shape (C, G).
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


@entry_point
def nearest_of_scenes(
    si: Integers, sf: Floats, sg: Singles, first: Integers, points: Floats, limit: float, distances: Floats,
    gradients: Floats,
) -> None:  # fmt: skip
    """Put the signed distances of points from the nearest obstacles of their scenes into ``distances`` [m].

    Args:
        si: The obstacles: integers, floats and singles.
        sf: See ``si``.
        sg: See ``si``.
        first: First obstacle of each scene, and the number of all, shape (B + 1,).
        points: Points of each scene, shape (B, N, 3) [m].
        limit: Larger distances are given as this [m].
        distances: Gets the distances, shape (B, N) [m].
        gradients: Gets their gradients, shape (B, N, 3), 0 at the limit.
    """
    s = scene_view(si, sf, sg)
    for b in range(len(points)):
        for n in range(points.shape[1]):
            x, y, z = points[b, n, 0], points[b, n, 1], points[b, n, 2]
            best, nearest = limit, -1
            for o in range(first[b], first[b + 1]):
                d = distance(s, o, x, y, z)
                if d < best:
                    best, nearest = d, o
            distances[b, n] = best
            gradients[b, n, 0] = gradients[b, n, 1] = gradients[b, n, 2] = 0.0
            if nearest >= 0:
                gradients[b, n, 0], gradients[b, n, 1], gradients[b, n, 2] = direction(s, nearest, x, y, z)


@entry_point
def least_distances(
    si: Integers, sf: Floats, sg: Singles, owner: Integers, balls: Floats, room: Floats, least: Floats
) -> None:
    """Put the least distance of each of T obstacles from the balls of its scene into ``least``, shape (T,) [m].

    Args:
        si: The obstacles: integers, floats and singles.
        sf: See ``si``.
        sg: See ``si``.
        owner: The scene of each, shape (T,).
        balls: Centers and radii, shape (B, 4, N) [m].
        room: Shape (N,).
        least: Gets the distances.
    """
    s = scene_view(si, sf, sg)
    for t in range(len(owner)):
        for n in range(len(room)):
            room[n] = math.inf
        lower_to_distances(s, t, balls[owner[t]], room)
        best = math.inf
        for n in range(len(room)):
            best = min(best, room[n])
        least[t] = best


@entry_point
def clearances_alone(
    si: Integers, sf: Floats, sg: Singles, outer: Floats, balls: Floats, limit: float, room: Floats, clearances: Floats
) -> None:  # fmt: skip
    """Put the least distances of groups of balls from each obstacle alone into ``clearances``, shape (T, G) [m].

    Args:
        si: The obstacles: integers, floats and singles.
        sf: See ``si``.
        sg: See ``si``.
        outer: Balls that contain those of a cluster, shape (C, 4, G) [m].
        balls: Centers and radii, shape (G, C, 1 + M, 4): M balls of each of C clusters after the outer one [m].
        limit: Larger clearances are given as this [m].
        room: Shape (C, G).
        clearances: Gets the clearances.
    """
    s = scene_view(si, sf, sg)
    groups, clusters, many = balls.shape[0], balls.shape[1], balls.shape[2]
    for t in range(len(clearances)):
        for c in range(clusters):
            for g in range(groups):
                room[c, g] = math.inf
            lower_to_distances(s, t, outer[c], room[c])
        for g in range(groups):
            best = limit
            for c in range(clusters):
                if room[c, g] < best:
                    for m in range(1, many):
                        ball = balls[g, c, m]
                        best = min(best, distance(s, t, ball[0], ball[1], ball[2]) - ball[3])
            clearances[t, g] = best
