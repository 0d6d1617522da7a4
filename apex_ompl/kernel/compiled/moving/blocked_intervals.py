"""Intervals of time in which dynamic obstacles block places along a motion.

The places are pieces of the path, from one parameter to another. The robot is placed in the middle of each, and its
spheres grow by the bound on their displacement over the piece (:mod:`apex_ompl.kernel.compiled.robot.motion_bound`), so
that a result for the spheres at rest holds for every state of the piece. A cluster whose ball never meets a dynamic
obstacle is done; otherwise the trees of spheres of its bodies are searched down to the leaves, but not below a sphere
that adds no time to what is blocked already. The remaining intervals are the safe ones (Phillips and Likhachev 2011).

The times at which a ball at rest may meet a dynamic obstacle are found in closed form. In the frame of the dynamic
obstacle, at a time T after its stamp, a ball's center is at p + u T, and the ball meets the dynamic obstacle grown by
the ball's radius and the margin, R(T) = R + g T with g the growth of the margin, 0 before the stamp. The set of such T
is an interval: the distance is convex in T, and R linear. For

- balls |p + u T| <= R(T) is a quadratic inequality;
- capsules it is the union of that for both ends and of that across the axis, as long as p + u T is between the ends;
- boxes |p_i + u_i T| <= h_i + R(T) are two linear inequalities an axis (slabs: a bound at edges and corners);
- cylinders the bound is that across the axis and a slab along it (at the rims);
- grids of distances the bound is the box of the grid.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, GRID, SPHERE, RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import is_allowed
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import (
    DynamicArrays,
    dynamic_view,
    scene_of_dynamic,
    set_interval,
)
from apex_ompl.kernel.compiled.moving.time_sets import add_span, holds_span
from apex_ompl.kernel.compiled.robot.kinematics import node_position, place_cluster
from apex_ompl.kernel.compiled.robot.motion_bound import cluster_displacement
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

NEVER = (math.inf, -math.inf)
STILL = 1e-15  # squared speed below which nothing moves [m^2/s^2]
ROUNDING = 1e-9  # added to radii [m]

Interval = tuple[float, float]


@inlined
def _below(a: float, b: float, within: Interval) -> Interval:
    """Return the part of an interval in which a + b T <= 0."""
    if b > 0.0:
        return within[0], min(within[1], -a / b)
    if b < 0.0:
        return max(within[0], -a / b), within[1]
    return within if a <= 0.0 else NEVER


@inlined
def _in_slab(p: float, u: float, half: float, growth: float, within: Interval) -> Interval:
    """Return the part of an interval in which |p + u T| <= half + growth T."""
    return _below(-p - half, -u - growth, _below(p - half, u - growth, within))


@inlined
def _in_ball(c: float, b: float, a: float, radius: float, growth: float, within: Interval) -> Interval:
    """Return the part of an interval in which |p + u T| <= radius + growth T; within T >= 0 where there is growth.

    Args:
        c: p . p.
        b: p . u.
        a: u . u.
        radius: See above.
        growth: See above.
        within: The interval.
    """
    a, b, c = a - growth * growth, b - radius * growth, c - radius * radius
    if abs(a) <= STILL:
        return _below(c, 2.0 * b, within)
    root = b * b - a * c
    if a < 0.0:
        if c <= 0.0:
            return within
        return max(within[0], (-b - math.sqrt(max(root, 0.0))) / a), within[1]
    if root < 0.0:
        return NEVER
    root = math.sqrt(root)
    return max(within[0], (-b - root) / a), min(within[1], (-b + root) / a)


@inlined
def _hull(one: Interval, other: Interval) -> Interval:
    """Return the smallest interval around two, of which either may be empty."""
    if one[0] > one[1]:
        return other
    if other[0] > other[1]:
        return one
    return min(one[0], other[0]), max(one[1], other[1])


@inlined
def _in_shape(
    m: DynamicArrays, o: int, p: tuple[float, float, float], u: tuple[float, float, float],
    radius: float, growth: float, within: Interval,
) -> Interval:  # fmt: skip
    """Return the part of an interval in which p + u T may be within radius + growth T of an obstacle, in its frame."""
    kind, size = m.kind[o], m.size[o]
    if kind == BOX:
        for i in range(3):
            within = _in_slab(p[i], u[i], size[i] + radius, growth, within)
        return within
    if kind == GRID:
        for i in range(3):
            half = 0.5 * size[0] * (m.grid[o, 1 + i] - 1)
            within = _in_slab(p[i] - half, u[i], half + radius, growth, within)
        return within
    c, b, a = p[0] * p[0] + p[1] * p[1], p[0] * u[0] + p[1] * u[1], u[0] * u[0] + u[1] * u[1]
    radius += size[0]
    if kind == SPHERE:
        return _in_ball(c + p[2] * p[2], b + p[2] * u[2], a + u[2] * u[2], radius, growth, within)
    across = _in_ball(c, b, a, radius, growth, within)
    if kind == CYLINDER:
        return _in_slab(p[2], u[2], size[1] + radius - size[0], growth, across)
    if kind != CAPSULE:
        return within
    found = _in_slab(p[2], u[2], size[1], 0.0, across)
    for end in (-size[1], size[1]):
        z = p[2] - end
        ball = _in_ball(c + z * z, b + z * u[2], a + u[2] * u[2], radius, growth, within)
        found = _hull(found, ball)
    return found


@inlined
def meeting_times(m: DynamicArrays, o: int, x: float, y: float, z: float, radius: float, within: Interval) -> Interval:
    """Return an interval that holds all times at which a ball may meet a dynamic obstacle.

    Args:
        m: The dynamic obstacles.
        o: Number of the dynamic obstacle.
        x: Center of the ball [m].
        y: The same.
        z: The same.
        radius: Of the ball [m].
        within: Interval of times, of the dynamic obstacles' stamps, that is examined [s].

    Returns:
        First and last time; the first is after the last where they never meet.
    """
    r, stamp, margin = m.rotation[o], m.stamp[o], radius + m.growth[o, 0] + ROUNDING
    d, v = (x - m.place[o, 0], y - m.place[o, 1], z - m.place[o, 2]), m.velocity[o]
    p = (
        r[0, 0] * d[0] + r[1, 0] * d[1] + r[2, 0] * d[2],
        r[0, 1] * d[0] + r[1, 1] * d[1] + r[2, 1] * d[2],
        r[0, 2] * d[0] + r[1, 2] * d[1] + r[2, 2] * d[2],
    )
    u = (
        -r[0, 0] * v[0] - r[1, 0] * v[1] - r[2, 0] * v[2],
        -r[0, 1] * v[0] - r[1, 1] * v[1] - r[2, 1] * v[2],
        -r[0, 2] * v[0] - r[1, 2] * v[1] - r[2, 2] * v[2],
    )
    first, last = within[0] - stamp, within[1] - stamp
    found = NEVER
    if last >= 0.0:
        found = _in_shape(m, o, p, u, margin, m.growth[o, 1], (max(first, 0.0), last))
    if first < 0.0:
        found = _hull(found, _in_shape(m, o, p, u, margin, 0.0, (first, min(last, 0.0))))
    return found[0] + stamp, found[1] + stamp


MOST_SPANS = 8  # of a place
TOGETHER = 8  # places that are tried at once first
TIME_ROUNDING = 1e-9  # added to intervals of time [s]


@inlined
def _add_body(
    t: RobotArrays, m: DynamicArrays, w: Workspace, b: int, o: int, shift: float, within: Interval, spans: Floats,
    count: int,
) -> int:  # fmt: skip
    """Add the times at which a body may meet a dynamic obstacle; return the number of intervals."""
    j, top = t.body_joint[b], 1
    w.stack[0] = t.body_root[b]
    while top > 0:
        top -= 1
        n = w.stack[top]
        x, y, z = node_position(t, w, j, n)
        first, last = meeting_times(m, o, x, y, z, t.node_radius[n] + shift, within)
        if first > last or holds_span(spans, count, first, last):
            continue
        if t.node_count[n] == 0:
            count = add_span(spans, count, first - TIME_ROUNDING, last + TIME_ROUNDING)
        for k in range(t.node_first[n], t.node_first[n] + t.node_count[n]):
            w.stack[top] = k
            top += 1
    return count


@inlined
def _add_place(
    t: RobotArrays, m: DynamicArrays, w: Workspace, q: Floats, within: Interval, spans: Floats, any_will_do: bool
) -> int:
    """Set the blocked intervals of the motion of ``w`` around a state; return their number."""
    allowed, count = scene_of_dynamic(m, m.place), 0
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        shift = cluster_displacement(w, c)
        x, y, z = w.ball[c]
        for o in range(len(m.kind)):
            first, last = meeting_times(m, o, x, y, z, t.cluster_ball[c, 3] + shift, within)
            if first > last or holds_span(spans, count, first, last):
                continue
            place_cluster(t, w, q, c)
            body = t.cluster_bodies[c, 0]
            for b in range(body, body + t.cluster_bodies[c, 1]):
                if not is_allowed(allowed, b, o):
                    count = _add_body(t, m, w, b, o, shift, within, spans, count)
            if count > 0 and any_will_do:
                return count
    return count


@entry_point
def blocked_intervals(
    ri: Integers, rf: Floats, mi: Integers, mf: Floats, ms: Singles, wi: Integers, wf: Floats,
    knots: Floats, states: Floats, rates: Floats, slack: float, places: Floats,
    start: float, end: float, state: Floats, spans: Floats, counts: Integers,
) -> None:  # fmt: skip
    """Find the times at which pieces of a path are blocked.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        mi: Dynamic obstacles, packed.
        mf: Dynamic obstacles.
        ms: Dynamic obstacles.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        knots: The path, as are the next two; see :func:`apex_ompl.kernel.compiled.check.curve.set_motion`.
        states: States at the knots.
        rates: Velocities and accelerations at the knots.
        slack: Distance from the path within which states count as being on it, of each joint [rad].
        places: Parameters of the starts and ends of the pieces, shape (P, 2); the same twice for one state.
        start: First time that is examined, of the dynamic obstacles' stamps [s].
        end: The last one [s].
        state: Buffer for a state, shape (dof,).
        spans: Gets the blocked intervals of each piece in their order, shape (P, MOST_SPANS, 2) [s].
        counts: Gets their numbers, shape (P,).
    """
    t, m = robot_view(ri, rf), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    within = (start, end)
    for p in range(len(places)):
        if p % TOGETHER == 0:
            last = min(p + TOGETHER, len(places)) - 1
            known_free = False
            if set_interval(t, knots, states, rates, slack, places[p, 0], places[last, 1], state, w):
                known_free = _add_place(t, m, w, state, within, spans[p], True) == 0
        counts[p] = 0
        if known_free:
            continue
        if set_interval(t, knots, states, rates, slack, places[p, 0], places[p, 1], state, w):
            counts[p] = _add_place(t, m, w, state, within, spans[p], False)
        else:
            spans[p, 0, 0], spans[p, 0, 1] = within
            counts[p] = 1
