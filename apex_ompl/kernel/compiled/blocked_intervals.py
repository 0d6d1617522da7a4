"""Intervals of time in which places along a motion are blocked by dynamic obstacles.

The places are pieces of the path, from one parameter to another: in the middle of each the robot is placed, and its
spheres grow by the bound on their displacement over the piece (:mod:`apex_ompl.kernel.compiled.motion_bound`), so that
what holds for them standing still holds for every state of the piece. A cluster's ball that never meets a dynamic
obstacle is done with; otherwise the trees of spheres of its bodies are searched down to the leaves, but not below a
sphere that adds no time to what is blocked already (Phillips and Likhachev 2011 call what is left safe intervals).
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.arrays import RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.dynamic_obstacle_intervals import Interval, meeting_times
from apex_ompl.kernel.compiled.dynamic_obstacles import DynamicArrays, dynamic_view, scene_of_dynamic, set_interval
from apex_ompl.kernel.compiled.kinematics import node_position, place_cluster
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.motion_bound import cluster_displacement
from apex_ompl.kernel.compiled.scene_tree import is_allowed
from apex_ompl.kernel.compiled.time_sets import add_span, holds_span
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

MOST_SPANS = 8  # of a place
TOGETHER = 8  # places that are tried at once first
ROUNDING = 1e-9  # added to intervals of time [s]


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
            count = add_span(spans, count, first - ROUNDING, last + ROUNDING)
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
    begin: float, end: float, state: Floats, spans: Floats, counts: Integers,
) -> None:  # fmt: skip
    """Find the times at which pieces of a path are blocked.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        mi: Dynamic obstacles, packed.
        mf: DynamicObstacles.
        ms: DynamicObstacles.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        knots: The path, as are the next two; see :func:`apex_ompl.kernel.compiled.curve.set_motion`.
        states: States at the knots.
        rates: Velocities and accelerations at the knots.
        slack: Distance from the path within which states count as being on it, of each joint [rad].
        places: Parameters of the begins and ends of the pieces, shape (P, 2); the same twice for one state.
        begin: First time that is looked at, of the dynamic obstacles' stamps [s].
        end: The last one [s].
        state: Buffer for a state, shape (dof,).
        spans: Gets the blocked intervals of each piece in their order, shape (P, MOST_SPANS, 2) [s].
        counts: Gets their numbers, shape (P,).
    """
    t, m = robot_view(ri, rf), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    within = (begin, end)
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
