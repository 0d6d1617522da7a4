"""Distances from obstacles of many scenes, without trees over them: each scene has some of them, one behind the other.

Of the scene's arrays, which are packed as :class:`.SceneArrays`, only kinds, places and sizes are filled in.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import scene_view
from apex_ompl.kernel.compiled.ball_groups import lower_to_distances
from apex_ompl.kernel.compiled.compilation import entry_point
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.signed_distance import direction, distance


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
        balls: Centers and radii, shape (G, C, 1 + M, 4): M balls of each of C clusters behind the outer one [m].
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
