"""Inside the kernel: which pairs the spheres cannot prove to be apart, at a state or in a box of states around it."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled import inlined
from apex_ompl.kernel.kinematics import cluster_sway, node_x, open_cluster, pair_sway, place_robot
from apex_ompl.kernel.primitives import distance
from apex_ompl.kernel.tables import Floats, Integers, RobotArrays, SceneArrays
from apex_ompl.kernel.views import Work

# Every comparison asks for "further than", so that a number which is not one proves nothing.


@inlined
def body_clear(t: RobotArrays, s: SceneArrays, w: Work, b: int, o: int, sway: float) -> bool:
    """Whether a body whose spheres move by at most ``sway`` is proved to be off an obstacle."""
    j, top = t.body_joint[b], 1
    w.stack[0] = t.body_root[b]
    while top > 0:
        top -= 1
        n = w.stack[top]
        x, y, z = node_x(t, w, j, n)
        if distance(s, o, x, y, z) > t.node_radius[n] + sway:
            continue
        if t.node_count[n] == 0:
            return False
        for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
            w.stack[top] = k
            top += 1
    return True


@inlined
def bodies_clear(t: RobotArrays, w: Work, a: int, b: int, sway: float) -> bool:
    """Whether two bodies that move by at most ``sway`` relative to each other are proved to be apart."""
    ja, jb, top = t.body_joint[a], t.body_joint[b], 1
    w.stack[0], w.stack[1] = t.body_root[a], t.body_root[b]
    while top > 0:
        top -= 1
        m, n = w.stack[2 * top], w.stack[2 * top + 1]
        x, y, z = node_x(t, w, ja, m)
        u, v, r = node_x(t, w, jb, n)
        apart = t.node_radius[m] + t.node_radius[n] + sway
        if (x - u) ** 2 + (y - v) ** 2 + (z - r) ** 2 > apart * apart:
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
            return False
    return True


@inlined
def cluster_against(
    t: RobotArrays, s: SceneArrays, w: Work, q: Floats, c: int, o: int, found: Integers, count: int
) -> int:
    """Add the bodies of a cluster that are not proved to be off an obstacle; return how many pairs there are now."""
    sway = cluster_sway(w, c)
    if distance(s, o, w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]) > t.cluster_ball[c, 3] + sway:
        return count
    open_cluster(t, w, q, c)
    first = t.cluster_bodies[c, 0]
    for b in range(first, first + t.cluster_bodies[c, 1]):
        if distance(s, o, w.root[b, 0], w.root[b, 1], w.root[b, 2]) > t.node_radius[t.body_root[b]] + sway:
            continue
        if not body_clear(t, s, w, b, o, sway):
            found[count, 0], found[count, 1] = b, -1 - s.owner[o]
            count += 1
            if count == len(found):
                break
    return count


@inlined
def unproved_with_scene(t: RobotArrays, s: SceneArrays, w: Work, q: Floats, found: Integers, count: int) -> int:
    """Add the pairs of bodies and obstacles that are not proved to be apart."""
    obstacles = len(s.kind)
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        radius = t.cluster_ball[c, 3] + cluster_sway(w, c)
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        k = 0
        while k < len(s.tree_skip):
            low, high = s.tree_low[k], s.tree_high[k]
            dx = max(low[0] - x, x - high[0], 0.0)
            dy = max(low[1] - y, y - high[1], 0.0)
            dz = max(low[2] - z, z - high[2], 0.0)
            if dx * dx + dy * dy + dz * dz > radius * radius:
                k = s.tree_skip[k]
                continue
            first = s.tree_range[k, 0]
            for o in range(first, first + s.tree_range[k, 1]):
                count = cluster_against(t, s, w, q, c, o, found, count)
                if count == len(found):
                    return count
            k += 1
        for o in range(obstacles - s.open[0], obstacles):
            count = cluster_against(t, s, w, q, c, o, found, count)
            if count == len(found):
                return count
    return count


@inlined
def unproved_with_itself(t: RobotArrays, w: Work, q: Floats, found: Integers, count: int) -> int:
    """Add the pairs of bodies that are not proved to be apart from each other."""
    for p in range(len(t.pair_common)):
        a, b = t.pair_clusters[p, 0], t.pair_clusters[p, 1]
        common = t.pair_common[p]
        sway = pair_sway(w, a, b, common)
        if a != b:
            apart = t.cluster_ball[a, 3] + t.cluster_ball[b, 3] + sway
            u, v = w.ball[a], w.ball[b]
            if (u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2 > apart * apart:
                continue
        open_cluster(t, w, q, a)
        open_cluster(t, w, q, b)
        first = t.pair_bodies[p, 0]
        for k in range(first, first + t.pair_bodies[p, 1]):
            m, n = t.bodies[k, 0], t.bodies[k, 1]
            u, v = w.root[m], w.root[n]
            apart = t.node_radius[t.body_root[m]] + t.node_radius[t.body_root[n]] + sway
            if (u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2 > apart * apart:
                continue
            if not bodies_clear(t, w, m, n, sway):
                found[count, 0], found[count, 1] = m, n
                count += 1
                if count == len(found):
                    return count
    return count


@inlined
def known(t: RobotArrays, q: Floats, reach: Floats) -> bool:
    """Whether a box of states is finite, and inside the limits that the clusters' balls hold for."""
    for k in range(len(q)):
        if not math.isfinite(q[k]):
            return False
    for c in range(len(t.cluster_dof)):
        k = t.cluster_dof[c]
        if k >= 0 and not (q[k] - reach[k] >= t.lower[k] and q[k] + reach[k] <= t.upper[k]):
            return False
    return True


@inlined
def unproved(t: RobotArrays, s: SceneArrays, w: Work, q: Floats, found: Integers) -> int:
    """List the pairs that are not proved to be apart while the clusters move by at most ``w.sway``.

    ``found`` gets the pairs: two bodies, or a body and -1 - obstacle; the search ends when it is full.
    """
    count = unproved_with_scene(t, s, w, q, found, 0)
    if count == len(found):
        return count
    return unproved_with_itself(t, w, q, found, count)


@inlined
def proved(t: RobotArrays, s: SceneArrays, w: Work, q: Floats, one: Integers) -> bool:
    """Whether all pairs are proved to be apart; ``one`` is room for a pair."""
    return bool(unproved(t, s, w, q, one) == 0)


@inlined
def judged(t: RobotArrays, s: SceneArrays, w: Work, q: Floats, found: Integers) -> int:
    """Place the robot and list the pairs that are not proved to be apart at a state, see :func:`unproved`.

    Returns:
        The number of pairs, or -1 when nothing can be said of this state.
    """
    for k in range(len(q)):
        w.reach[k] = 0.0
    if not known(t, q, w.reach):
        return -1
    place_robot(t, w, q)
    w.flags[0] = 0
    return unproved(t, s, w, q, found)
