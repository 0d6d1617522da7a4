"""Inside the kernel: signed clearance of the cover's leaves, and its gradient with respect to the state."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled import inlined
from apex_ompl.kernel.kinematics import node_x, open_cluster
from apex_ompl.kernel.primitives import direction, distance
from apex_ompl.kernel.tables import FIXED, REVOLUTE, Floats, RobotArrays, SceneArrays
from apex_ompl.kernel.views import Work

Nearest = tuple[float, int, int, int, int]


@inlined
def nearest_to_obstacle(t: RobotArrays, s: SceneArrays, w: Work, q: Floats, c: int, o: int, best: Nearest) -> Nearest:
    """Return the nearer of ``best`` and the leaf of a cluster that is nearest to an obstacle.

    A result is a signed distance [m], a body and a leaf of it, and an obstacle with 0, or a body and a leaf.
    """
    if distance(s, o, w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]) - t.cluster_outer[c] >= best[0]:
        return best
    open_cluster(t, w, q, c)
    first = t.cluster_bodies[c, 0]
    for b in range(first, first + t.cluster_bodies[c, 1]):
        j, top = t.body_joint[b], 1
        w.stack[0] = t.body_root[b]
        while top > 0:
            top -= 1
            n = w.stack[top]
            x, y, z = node_x(t, w, j, n)
            d = distance(s, o, x, y, z)
            if d - t.node_outer[n] >= best[0]:
                continue
            if t.node_count[n] == 0:
                best = (d - t.node_radius[n], b, n, o, 0)
            for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
                w.stack[top] = k
                top += 1
    return best


@inlined
def nearest_obstacle(t: RobotArrays, s: SceneArrays, w: Work, q: Floats, limit: float) -> Nearest:
    """Return the nearest leaf and obstacle that are less than ``limit`` apart; see :func:`nearest_to_obstacle`."""
    best = (limit, -1, -1, -1, -1)
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        k = 0
        while k < len(s.tree_skip):
            low, high = s.tree_low[k], s.tree_high[k]
            dx = max(low[0] - x, x - high[0], 0.0)
            dy = max(low[1] - y, y - high[1], 0.0)
            dz = max(low[2] - z, z - high[2], 0.0)
            if math.sqrt(dx * dx + dy * dy + dz * dz) - t.cluster_outer[c] > max(best[0], 0.0):
                k = s.tree_skip[k]
                continue
            first = s.tree_range[k, 0]
            for o in range(first, first + s.tree_range[k, 1]):
                best = nearest_to_obstacle(t, s, w, q, c, o, best)
            k += 1
        for o in range(len(s.kind) - s.open[0], len(s.kind)):
            best = nearest_to_obstacle(t, s, w, q, c, o, best)
    return best


@inlined
def nearest_bodies(t: RobotArrays, w: Work, q: Floats, limit: float) -> Nearest:
    """Return the two nearest leaves of bodies that may touch, if they are less than ``limit`` apart."""
    best = (limit, -1, -1, -1, -1)
    for p in range(len(t.pair_common)):
        a, b = t.pair_clusters[p, 0], t.pair_clusters[p, 1]
        u, v = w.ball[a], w.ball[b]
        apart = math.sqrt((u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2)
        if a != b and apart - t.cluster_outer[a] - t.cluster_outer[b] >= best[0]:
            continue
        open_cluster(t, w, q, a)
        open_cluster(t, w, q, b)
        first = t.pair_bodies[p, 0]
        for k in range(first, first + t.pair_bodies[p, 1]):
            best = nearest_of_two(t, w, t.bodies[k, 0], t.bodies[k, 1], best)
    return best


@inlined
def nearest_of_two(t: RobotArrays, w: Work, a: int, b: int, best: Nearest) -> Nearest:
    """Return the nearer of ``best`` and the two nearest leaves of two bodies."""
    ja, jb, top = t.body_joint[a], t.body_joint[b], 1
    w.stack[0], w.stack[1] = t.body_root[a], t.body_root[b]
    while top > 0:
        top -= 1
        m, n = w.stack[2 * top], w.stack[2 * top + 1]
        x, y, z = node_x(t, w, ja, m)
        u, v, r = node_x(t, w, jb, n)
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
    t: RobotArrays, w: Work, j: int, x: float, y: float, z: float, n: tuple[float, float, float], out: Floats
) -> None:
    """Add n . dx/dq for a point x that is fixed to a joint's frame, in the world: the joint's column of a Jacobian."""
    while j > 0:
        kind = t.joint_kind[j]
        if kind != FIXED:
            r, o = w.turn[j], w.origin[j]
            if kind == REVOLUTE:
                u, v, k = x - o[0], y - o[1], z - o[2]
                part = (
                    n[0] * (r[1, 2] * k - r[2, 2] * v)
                    + n[1] * (r[2, 2] * u - r[0, 2] * k)
                    + n[2] * (r[0, 2] * v - r[1, 2] * u)
                )
            else:
                part = n[0] * r[0, 2] + n[1] * r[1, 2] + n[2] * r[2, 2]
            out[t.joint_source[j]] += part * t.joint_ratio[j]
        j = t.joint_parent[j]


@inlined
def gradient_to_obstacle(t: RobotArrays, s: SceneArrays, w: Work, found: Nearest, out: Floats) -> None:
    """Add the gradient of the distance of a leaf to an obstacle."""
    j = t.body_joint[found[1]]
    x, y, z = node_x(t, w, j, found[2])
    add_gradient(t, w, j, x, y, z, direction(s, found[3], x, y, z), out)


@inlined
def gradient_of_two(t: RobotArrays, w: Work, found: Nearest, out: Floats) -> None:
    """Add the gradient of the distance of two leaves."""
    ja, jb = t.body_joint[found[1]], t.body_joint[found[3]]
    x, y, z = node_x(t, w, ja, found[2])
    u, v, r = node_x(t, w, jb, found[4])
    long = math.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - r) ** 2)
    if not long > 0.0:
        return
    n = ((x - u) / long, (y - v) / long, (z - r) / long)
    add_gradient(t, w, ja, x, y, z, n, out)
    add_gradient(t, w, jb, u, v, r, (-n[0], -n[1], -n[2]), out)
