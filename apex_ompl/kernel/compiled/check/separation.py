"""Proofs by balls that pairs of bodies are apart, at a state or during a motion around it, or that they collide.

A pair is proved apart when the distance of all spheres that still have to be examined exceeds their radii plus a bound
on their displacement (:mod:`apex_ompl.kernel.compiled.robot.motion_bound`). The cover contains the solids, so that a
proved pair is free of collision; a pair that is not proved may be either. Two links with a table of clearances
(:mod:`apex_ompl.kernel.compiled.check.clearance_table`) are proved apart by it first.

A body is proved to collide with an obstacle where a ball inside of the body meets it. The meshes would find the same:
an obstacle that meets a ball inside of a closed solid either crosses its surface or is inside of it.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import GRID, LIMIT_SLACK, RUN, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.check.clearance_table import proved_by_table
from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.geometry.bounding_trees import items_apart
from apex_ompl.kernel.compiled.geometry.grid_distance import FARTHER, compare
from apex_ompl.kernel.compiled.geometry.signed_distance import (
    apart,
    ball_apart,
    distance,
    is_allowed,
    local_point,
    next_obstacles,
)
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.robot.kinematics import (
    bin_of,
    mark_pair,
    node_position,
    place_cluster,
    place_part,
    place_robot,
    point_position,
)
from apex_ompl.kernel.compiled.robot.motion_bound import cluster_displacement, relative_displacement
from apex_ompl.kernel.compiled.workspace import Workspace

DEPTH = 5e-4  # by which a ball must meet an obstacle, many times what rounding and Coal's tolerances are worth [m]


@inlined
def ball_meets(s: SceneArrays, o: int, x: float, y: float, z: float, radius: float) -> bool:
    """Whether a ball is proved to meet an obstacle whose shape the tables have: its surface, where it is a mesh."""
    reach = radius - DEPTH
    if s.kind[o] != GRID:
        return distance(s, o, x, y, z) < reach
    a, b, c = local_point(s, o, x, y, z)
    if compare(s.grid[o], s.values, s.size[o, 0], a, b, c, reach) == FARTHER:
        return False
    reach += s.size[o, 2]
    return reach > 0.0 and not items_apart(s.grid[o], s.values, a, b, c, reach)


@inlined
def collides(t: RobotArrays, s: SceneArrays, w: Workspace, found: Integers, count: int) -> bool:
    """Whether one of some pairs of a body and an obstacle is proved to collide at the state for which ``w`` is placed.

    Args:
        t: The robot.
        s: The scene.
        w: Workspace, in which the clusters of the pairs are placed.
        found: Pairs, shape (K, 2): a body and -1 - owner of an obstacle, or two bodies, which are left alone.
        count: Number of pairs.
    """
    for k in range(count):
        owner = -1 - found[k, 1]
        if owner < 0:
            continue
        b = found[k, 0]
        j, first = t.body_joint[b], t.body_inner[b, 0]
        for o in range(len(s.kind)):
            if s.owner[o] != owner or not s.exact[o]:
                continue
            for n in range(first, first + t.body_inner[b, 1]):
                x, y, z = point_position(w, j, t.inner_ball[n])
                if ball_meets(s, o, x, y, z, t.inner_ball[n, 3]):
                    return True
    return False


UNKNOWN, COLLIDES = -1, -2  # in place of the number of pairs at a state
EVERY = (1 << RUN) - 1  # pairs of a run, as bits

# Every comparison is of the form "distance > bound", which is false for NaN: such a state is never proved free.


@inlined
def body_clear(t: RobotArrays, s: SceneArrays, w: Workspace, b: int, o: int, shift: float) -> bool:
    """Whether a body whose spheres move by at most ``shift`` [m] is proved apart from an obstacle."""
    j, top = t.body_joint[b], 1
    w.stack[0] = t.body_root[b]
    while top > 0:
        top -= 1
        n = w.stack[top]
        x, y, z = node_position(t, w, j, n)
        if t.node_count[n] == 0:
            if not ball_apart(s, o, x, y, z, t.node_radius[n] + shift):
                return False
            continue
        if apart(s, o, x, y, z, t.node_radius[n] + shift):
            continue
        for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
            w.stack[top] = k
            top += 1
    return True


@inlined
def bodies_clear(t: RobotArrays, w: Workspace, a: int, b: int, shift: float) -> bool:
    """Whether two bodies that move by at most ``shift`` [m] relative to each other are proved apart."""
    ja, jb, top = t.body_joint[a], t.body_joint[b], 1
    w.stack[0], w.stack[1] = t.body_root[a], t.body_root[b]
    while top > 0:
        top -= 1
        m, n = w.stack[2 * top], w.stack[2 * top + 1]
        x, y, z = node_position(t, w, ja, m)
        u, v, r = node_position(t, w, jb, n)
        apart = t.node_radius[m] + t.node_radius[n] + shift
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
def part_clear(t: RobotArrays, s: SceneArrays, w: Workspace, c: int, p: int, k: int, o: int, shift: float) -> bool:
    """Whether part ``p`` of cluster ``c``, of several, is apart from an obstacle by its ball of range ``k``."""
    if t.cluster_parts[c, 1] == 1:
        return False
    x, y, z = point_position(w, t.cluster_joint[c], t.part_ball[p, k])
    return apart(s, o, x, y, z, t.part_ball[p, k, 3] + shift)


@inlined
def cluster_against(
    t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, c: int, o: int, found: Integers, count: int
) -> int:
    """Add to ``found`` a cluster's bodies that are not proved apart from an obstacle; return the number of pairs."""
    shift = cluster_displacement(w, c)
    reach = t.cluster_ball[c, 3] + shift
    if apart(s, o, w.ball[c, 0], w.ball[c, 1], w.ball[c, 2], reach):
        return count
    first, k = t.cluster_parts[c, 0], bin_of(t, q, c)
    for p in range(first, first + t.cluster_parts[c, 1]):
        if part_clear(t, s, w, c, p, k, o, shift):
            continue
        place_part(t, w, q, p)
        for b in range(t.part_bodies[p, 0], t.part_bodies[p, 0] + t.part_bodies[p, 1]):
            reach = t.node_radius[t.body_root[b]] + shift
            if apart(s, o, w.root[b, 0], w.root[b, 1], w.root[b, 2], reach):
                continue
            if not body_clear(t, s, w, b, o, shift) and not is_allowed(s, b, o):
                found[count, 0], found[count, 1] = b, -1 - s.owner[o]
                count += 1
                if count == len(found):
                    return count
    return count


@inlined
def unproved_with_obstacles(
    t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, found: Integers, count: int
) -> int:
    """Add to ``found`` the bodies and obstacles that are not proved apart; return the number of pairs."""
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        radius = t.cluster_ball[c, 3] + cluster_displacement(w, c)
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        k = 0
        while True:
            k, first, end = next_obstacles(s, x, y, z, radius, k)
            if first == end:
                break
            for o in range(first, end):
                count = cluster_against(t, s, w, q, c, o, found, count)
                if count == len(found):
                    return count
    return count


@inlined
def near_of_run(w: Workspace, a: int, b: int, number: int) -> int:
    """Return the bits of those of ``number`` clusters, at most RUN, from ``b`` on, whose balls meet that of ``a``."""
    x, y, z, radius = w.ball_rows[0, a], w.ball_rows[1, a], w.ball_rows[2, a], w.ball_rows[3, a]
    us, vs, ws = w.ball_rows[0, b : b + RUN], w.ball_rows[1, b : b + RUN], w.ball_rows[2, b : b + RUN]
    radii, near = w.ball_rows[3, b : b + RUN], 0
    for k in range(RUN):
        apart = radius + radii[k]
        far = (x - us[k]) ** 2 + (y - vs[k]) ** 2 + (z - ws[k]) ** 2 > apart * apart
        near |= 0 if far or k >= number else 1 << k
    return near


@inlined
def unproved_of_pair(t: RobotArrays, w: Workspace, q: Floats, p: int, found: Integers, count: int) -> int:
    """Add to ``found`` the bodies of a pair of clusters that are not proved apart; return the number of pairs."""
    a, b = t.pair_clusters[p, 0], t.pair_clusters[p, 1]
    shift = relative_displacement(w, a, b, t.pair_common[p])
    if a != b:
        apart = t.cluster_ball[a, 3] + t.cluster_ball[b, 3] + shift
        u, v = w.ball[a], w.ball[b]
        if (u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2 > apart * apart:
            return count
        if not mark_pair(t, w, q, False, p, shift):
            return count
    else:
        place_cluster(t, w, q, a)
    first = t.pair_bodies[p, 0]
    for k in range(first, first + t.pair_bodies[p, 1]):
        m, n = t.bodies[k, 0], t.bodies[k, 1]
        if a != b and not (w.near[m] and w.near[n]):
            continue
        u, v = w.root[m], w.root[n]
        apart = t.node_radius[t.body_root[m]] + t.node_radius[t.body_root[n]] + shift
        if (u[0] - v[0]) ** 2 + (u[1] - v[1]) ** 2 + (u[2] - v[2]) ** 2 > apart * apart:
            continue
        if t.bodies_table[k] >= 0 and proved_by_table(t, k, q, w.half_width, w.margin[0]):
            continue
        if not bodies_clear(t, w, m, n, shift):
            found[count, 0], found[count, 1] = m, n
            count += 1
            if count == len(found):
                break
    return count


@inlined
def unproved_between_bodies(t: RobotArrays, w: Workspace, q: Floats, found: Integers, count: int) -> int:
    """Add to ``found`` the bodies that are not proved apart from each other; return the number of pairs."""
    for r in range(len(t.run_pairs)):
        a, number = t.run_pairs[r, 0], t.run_pairs[r, 3]
        near = near_of_run(w, a, t.run_pairs[r, 1], number) if w.moving[0] == 0 else EVERY
        for k in range(number):
            if not near:
                break
            if near & 1:
                count = unproved_of_pair(t, w, q, t.run_pairs[r, 2] + k, found, count)
                if count == len(found):
                    return count
            near >>= 1
    return count


@inlined
def tables_hold(t: RobotArrays, q: Floats, half_width: Floats) -> bool:
    """Whether a box of states is finite, and inside the limits for which the clusters' balls were made, rounded."""
    for k in range(len(q)):
        if not math.isfinite(q[k]):
            return False
    for c in range(len(t.cluster_dof)):
        k = t.cluster_dof[c]
        low, high = t.lower[k] - LIMIT_SLACK, t.upper[k] + LIMIT_SLACK
        if k >= 0 and not (q[k] - half_width[k] >= low and q[k] + half_width[k] <= high):
            return False
    return True


@inlined
def unproved(t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, found: Integers) -> int:
    """Put the pairs that are not proved apart into ``found`` (K, 2), at the state and during the motion of ``w``.

    A pair is two bodies, or a body and -1 - obstacle; the search ends when ``found`` is full.

    Returns:
        The number of pairs.
    """
    count = unproved_with_obstacles(t, s, w, q, found, 0)
    if count == len(found):
        return count
    return unproved_between_bodies(t, w, q, found, count)


@inlined
def unproved_at_state(t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, found: Integers) -> int:
    """Place the robot at a state and put the pairs that are not proved apart into ``found``, see :func:`unproved`.

    Returns:
        The number of pairs, UNKNOWN where the tables do not hold for the state, COLLIDES where it is proved to collide.
    """
    for k in range(len(q)):
        w.half_width[k] = 0.0
    if not tables_hold(t, q, w.half_width):
        return UNKNOWN
    place_robot(t, w, q)
    w.moving[0] = 0
    count = unproved(t, s, w, q, found)
    return COLLIDES if count > 0 and collides(t, s, w, found, count) else count
