"""Clearance cost of a state, its gradient and its Gauss-Newton matrix.

With the clearance d_k of every cluster to every obstacle, of every pair of clusters, and the margin m, the violations
and the cost are

    r_k = max(0, (m - d_k) / m),   c = 1/2 sum_k r_k^2,   dc/dq = -sum_k r_k u_k,   G = sum_k u_k u_k^T,

where u_k = (dd_k/dq) / m. There is one margin for the scene and one for self-collision. Distances of grids, which are
lowered to be bounds elsewhere, count here as they were found: near smooth surfaces they are right.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import GRID, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.check.clearance import (
    Nearest,
    gradient_between_bodies,
    gradient_to_obstacle,
    nearest_of_bodies,
    nearest_to_obstacle,
)
from apex_ompl.kernel.compiled.compilation import reassociating_inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import next_obstacles
from apex_ompl.kernel.compiled.layout import Floats
from apex_ompl.kernel.compiled.robot.kinematics import mark_pair, place_cluster, place_robot
from apex_ompl.kernel.compiled.workspace import Workspace


class StateCost(NamedTuple):
    """Clearance cost of a state.

    Attributes:
        cost: The cost.
        scene: Clearance to the scene, at most the one it was compared with [m].
        own: Clearance between links, at most the one it was compared with [m].
    """

    cost: float
    scene: float
    own: float


@reassociating_inlined
def add_violation(clearance: float, margin: float, row: Floats, gradient: Floats, gram: Floats) -> float:
    """Add the square of a violation whose clearance has the gradient ``row``, which is scaled; return its cost."""
    first, last, scale = len(row), -1, 1.0 / margin  # joints that move it: those of one arm mostly
    for i in range(len(row)):
        if row[i] != 0.0:
            row[i] *= scale
            first, last = min(first, i), i
    violation = (margin - clearance) / margin
    for i in range(first, last + 1):
        u = row[i]
        if u != 0.0:
            gradient[i] -= violation * u
            for k in range(first, i + 1):
                gram[i, k] += u * row[k]
    return 0.5 * violation * violation


@reassociating_inlined
def nearest_of_pair(t: RobotArrays, w: Workspace, q: Floats, p: int, margin: float) -> Nearest:
    """Return the nearest leaves of pair ``p`` of clusters, if they are less than ``margin`` apart."""
    near: Nearest = (margin, -1, -1, -1, -1)
    a, b = t.pair_clusters[p, 0], t.pair_clusters[p, 1]
    u, v = w.ball[a], w.ball[b]
    apart = math.sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2)
    if a == b:
        place_cluster(t, w, q, a)
    else:
        far = apart - t.cluster_outer[b] >= t.cluster_outer[a] + margin
        if far or not mark_pair(t, w, q, True, p, margin):
            return near
    first = t.pair_bodies[p, 0]
    for k in range(first, first + t.pair_bodies[p, 1]):
        m, n = t.bodies[k, 0], t.bodies[k, 1]
        if a == b or (w.near[m] and w.near[n]):
            near = nearest_of_bodies(t, w, q, k, near)
    return near


@reassociating_inlined
def state_cost(
    t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, scene_margin: float, own_margin: float, row: Floats,
    gradient: Floats, gram: Floats, scene: float, own: float,
) -> StateCost:  # fmt: skip
    """Return the clearance cost of a state; put its gradient (dof,) and the lower half of G (dof, dof) into place.

    ``row`` (dof,) is memory to work in; ``scene`` and ``own`` are the smallest clearances so far.
    """
    for i in range(len(gradient)):
        gradient[i] = 0.0
        for k in range(i + 1):
            gram[i, k] = 0.0
    place_robot(t, w, q)
    cost = 0.0
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        radius = t.cluster_outer[c] + scene_margin
        n = 0
        while True:
            n, first, end = next_obstacles(s, x, y, z, radius, n)
            if first == end:
                break
            for o in range(first, end):
                lowered = s.size[o, 1] if s.kind[o] == GRID else 0.0
                near = nearest_to_obstacle(t, s, w, q, c, o, (scene_margin - lowered, -1, -1, -1, -1))
                if near[1] >= 0:
                    clearance = near[0] + lowered
                    scene = min(scene, clearance)
                    for i in range(len(row)):
                        row[i] = 0.0
                    gradient_to_obstacle(t, s, w, near, row)
                    cost += add_violation(clearance, scene_margin, row, gradient, gram)
    for p in range(len(t.pair_common)):
        near = nearest_of_pair(t, w, q, p, own_margin)
        if near[1] >= 0:
            own = min(own, near[0])
            for i in range(len(row)):
                row[i] = 0.0
            gradient_between_bodies(t, w, near, row)
            cost += add_violation(near[0], own_margin, row, gradient, gram)
    return StateCost(cost, scene, own)
