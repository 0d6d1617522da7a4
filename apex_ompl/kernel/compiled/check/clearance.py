"""Signed clearance of the sphere cover, and its gradient with respect to the state.

The clearance to the scene is min (d_o(x_n) - r_n) over obstacles o and leaf spheres n with center x_n and radius r_n,
d_o being the signed distance to the obstacle; between links it is min (|x_m - x_n| - r_m - r_n). The gradient is that
of the nearest pair, n . J with the unit vector n from one to the other and the point's Jacobian J.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.check.clearance_table import clearance_of_cell, is_bearing
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import direction, distance, is_allowed, next_obstacles
from apex_ompl.kernel.compiled.layout import Floats
from apex_ompl.kernel.compiled.robot.kinematics import (
    bin_of,
    mark_pair,
    node_position,
    place_cluster,
    place_part,
    point_position,
)
from apex_ompl.kernel.compiled.workspace import Workspace

Nearest = tuple[float, int, int, int, int]
"""Signed distance [m], a body and a leaf of it, then an obstacle and 0, or another body and a leaf; -1 for none."""


@inlined
def nearest_leaf(t: RobotArrays, s: SceneArrays, w: Workspace, b: int, o: int, slack: float, best: Nearest) -> Nearest:
    """Return the nearer of ``best`` and the leaf of a body that is nearest to an obstacle."""
    j, top = t.body_joint[b], 0 if is_allowed(s, b, o) else 1
    w.stack[0] = t.body_root[b]
    while top > 0:
        top -= 1
        n = w.stack[top]
        x, y, z = node_position(t, w, j, n)
        d = distance(s, o, x, y, z, best[0] + t.node_outer[n] + slack)
        if d - t.node_outer[n] >= best[0]:
            continue
        if t.node_count[n] == 0:
            best = (d - t.node_radius[n], b, n, o, 0)
        for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
            w.stack[top] = k
            top += 1
    return best


@inlined
def nearest_to_obstacle(
    t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, c: int, o: int, best: Nearest
) -> Nearest:
    """Return the nearer of ``best`` and the leaf of a cluster that is nearest to an obstacle."""
    # A coarser bound is less than half a cell's diagonal above the interpolated one, by which values were lowered.
    slack = s.size[o, 1]
    outer = t.cluster_outer[c]
    if distance(s, o, w.ball[c, 0], w.ball[c, 1], w.ball[c, 2], best[0] + outer + slack) - outer >= best[0]:
        return best
    first, k = t.cluster_parts[c, 0], bin_of(t, q, c)
    for p in range(first, first + t.cluster_parts[c, 1]):
        if t.cluster_parts[c, 1] > 1:
            outer = t.part_outer[p, k]
            x, y, z = point_position(w, t.cluster_joint[c], t.part_ball[p, k])
            if distance(s, o, x, y, z, best[0] + outer + slack) - outer >= best[0]:
                continue
        place_part(t, w, q, p)
        for b in range(t.part_bodies[p, 0], t.part_bodies[p, 0] + t.part_bodies[p, 1]):
            best = nearest_leaf(t, s, w, b, o, slack, best)
    return best


@inlined
def nearest_obstacle(t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, limit: float) -> Nearest:
    """Return the nearest leaf and obstacle that are less than ``limit`` apart."""
    best = (limit, -1, -1, -1, -1)
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        k = 0
        while True:
            radius = t.cluster_outer[c] + max(best[0], 0.0)
            k, first, end = next_obstacles(s, x, y, z, radius, k)
            if first == end:
                break
            for o in range(first, end):
                best = nearest_to_obstacle(t, s, w, q, c, o, best)
    return best


@inlined
def nearest_bodies(t: RobotArrays, w: Workspace, q: Floats, limit: float) -> Nearest:
    """Return the two nearest leaves of bodies that are checked for self-collision, if less than ``limit`` apart."""
    best = (limit, -1, -1, -1, -1)
    for p in range(len(t.pair_common)):
        a, b = t.pair_clusters[p, 0], t.pair_clusters[p, 1]
        u, v = w.ball[a], w.ball[b]
        apart = math.sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2)
        if a != b and apart - t.cluster_outer[a] - t.cluster_outer[b] >= best[0]:
            continue
        marked = a != b and best[0] < math.inf
        if marked and not mark_pair(t, w, q, True, p, best[0]):
            continue
        if not marked:
            place_cluster(t, w, q, a)
            place_cluster(t, w, q, b)
        first = t.pair_bodies[p, 0]
        for k in range(first, first + t.pair_bodies[p, 1]):
            m, n = t.bodies[k, 0], t.bodies[k, 1]
            if not marked or (w.near[m] and w.near[n]):
                best = nearest_of_bodies(t, w, q, k, best)
    return best


@inlined
def nearest_of_bodies(t: RobotArrays, w: Workspace, q: Floats, k: int, best: Nearest) -> Nearest:
    """Return the nearer of ``best`` and the nearest leaves of pair ``k`` of bodies, not nearer than its table shows.

    Bearings do not count.
    """
    apart = clearance_of_cell(t, k, q) if t.bodies_table[k] >= 0 else 0.0
    if apart > 0.0 and (apart >= best[0] or is_bearing(t, k, apart)):
        return best
    found = nearest_leaves(t, w, t.bodies[k, 0], t.bodies[k, 1], best)
    if apart > 0.0 and found[0] < best[0]:
        found = (max(found[0], apart), found[1], found[2], found[3], found[4])
    return found


@inlined
def nearest_leaves(t: RobotArrays, w: Workspace, a: int, b: int, best: Nearest) -> Nearest:
    """Return the nearer of ``best`` and the two nearest leaves of two bodies."""
    ja, jb, top = t.body_joint[a], t.body_joint[b], 1
    w.stack[0], w.stack[1] = t.body_root[a], t.body_root[b]
    while top > 0:
        top -= 1
        m, n = w.stack[2 * top], w.stack[2 * top + 1]
        x, y, z = node_position(t, w, ja, m)
        u, v, r = node_position(t, w, jb, n)
        d = math.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - r) ** 2)
        if d - t.node_outer[m] - t.node_outer[n] >= best[0]:
            continue
        first = t.node_count[m] > 0 and (t.node_count[n] == 0 or t.node_radius[m] >= t.node_radius[n])
        if first:
            for k in range(t.node_first[m], t.node_first[m] + t.node_count[m]):
                w.stack[2 * top], w.stack[2 * top + 1] = k, n
                top += 1
        elif t.node_count[n] > 0:
            for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
                w.stack[2 * top], w.stack[2 * top + 1] = m, k
                top += 1
        else:
            best = (d - t.node_radius[m] - t.node_radius[n], a, m, b, n)
    return best


@inlined
def add_gradient(
    t: RobotArrays, w: Workspace, j: int, x: float, y: float, z: float, n: tuple[float, float, float], out: Floats
) -> None:
    """Add n . dx/dq to ``out`` (dof,) for a point x that is fixed to the frame of joint ``j``, all in the world."""
    while j > 0:
        kind = t.joint_kind[j]
        if kind != FIXED:
            r, o = w.rotation[j], w.origin[j]
            if kind == REVOLUTE:
                u, v, k = x - o[0], y - o[1], z - o[2]
                column = (
                    n[0] * (r[1, 2] * k - r[2, 2] * v)
                    + n[1] * (r[2, 2] * u - r[0, 2] * k)
                    + n[2] * (r[0, 2] * v - r[1, 2] * u)
                )
            else:
                column = n[0] * r[0, 2] + n[1] * r[1, 2] + n[2] * r[2, 2]
            out[t.joint_source[j]] += column * t.joint_ratio[j]
        j = t.joint_parent[j]


@inlined
def gradient_to_obstacle(t: RobotArrays, s: SceneArrays, w: Workspace, found: Nearest, out: Floats) -> None:
    """Add the gradient of a leaf's distance to an obstacle to ``out`` (dof,)."""
    j = t.body_joint[found[1]]
    x, y, z = node_position(t, w, j, found[2])
    add_gradient(t, w, j, x, y, z, direction(s, found[3], x, y, z), out)


@inlined
def gradient_between_bodies(t: RobotArrays, w: Workspace, found: Nearest, out: Floats) -> None:
    """Add the gradient of the distance between two leaves to ``out`` (dof,); zero where their centers meet."""
    ja, jb = t.body_joint[found[1]], t.body_joint[found[3]]
    x, y, z = node_position(t, w, ja, found[2])
    u, v, r = node_position(t, w, jb, found[4])
    length = math.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - r) ** 2)
    if not length > 0.0:
        return
    n = ((x - u) / length, (y - v) / length, (z - r) / length)
    add_gradient(t, w, ja, x, y, z, n, out)
    add_gradient(t, w, jb, u, v, r, (-n[0], -n[1], -n[2]), out)
