"""Dynamic obstacles: their places in time, the proof of a motion among them, and clearances in time.

Dynamic obstacles stay out of the scene's tree. Dynamic obstacle o has the place p_o at its time stamp s_o, the velocity
v_o and a margin that may grow: at time t it stands at p_o + v_o (t - s_o), and counts as larger by

    g_o(t) = growth_o0 + growth_o1 max(0, t - s_o).

It does not turn. In the middle of an interval of time the robot and the dynamic obstacles are placed; over the
interval, h on either side, a dynamic obstacle's own motion adds to that of the robot's spheres
(:mod:`apex_ompl.kernel.compiled.robot.motion_bound`): relative to a dynamic obstacle, a sphere moves by at most

    min(arc bound + |v_o| h,  |linear - v_o h| + remainder),

to which the margin at the end of the interval is added. Intervals are proved one after the other, each as long as it
can be, so that the first moment that is not proved is the earliest.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import (
    GRID_ROW,
    Pairs,
    RobotArrays,
    Rotations,
    SceneArrays,
    Vectors,
    robot_view,
)
from apex_ompl.kernel.compiled.check.clearance import Nearest, gradient_to_obstacle, nearest_to_obstacle
from apex_ompl.kernel.compiled.check.curve import set_motion, set_state
from apex_ompl.kernel.compiled.check.separation import body_clear, part_clear, tables_hold
from apex_ompl.kernel.compiled.compilation import entry_point, inlined, ir_inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import apart, direction, is_allowed
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles, table_view
from apex_ompl.kernel.compiled.robot.kinematics import bin_of, node_position, place_part, place_robot
from apex_ompl.kernel.compiled.robot.motion_bound import bound_displacements
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

LONGER = 1.6  # factor from an interval that was proved at once to the next
FIRST = 0.05  # length of the first interval [s]


class DynamicArrays(NamedTuple):
    """Arrays of M solids that move at constant velocity; those of one obstacle have the same ``owner``.

    ``kind``, ``owner``, ``grid``, ``rotation``, ``size``, ``values`` and ``allowed`` are those of
    :class:`apex_ompl.kernel.compiled.arrays.SceneArrays`; half-spaces do not move.

    Attributes:
        place: Where they stand at their time stamps, shape (M, 3) [m].
        velocity: Shape (M, 3) [m/s].
        stamp: Time stamps, shape (M,) [s].
        growth: Margin at the time stamp [m], and its growth after it [m/s], shape (M, 2).
    """

    kind: Integers
    owner: Integers
    grid: Annotated[Integers, GRID_ROW]
    allowed: Pairs
    rotation: Rotations
    place: Vectors
    size: Vectors
    velocity: Vectors
    stamp: Floats
    growth: Annotated[Floats, 2]
    values: Singles


dynamic_view = table_view(DynamicArrays)


@ir_inlined
def scene_of_dynamic(m: DynamicArrays, offset: Floats) -> SceneArrays:
    """Return dynamic obstacles as a scene without a tree, at the places in ``offset`` (M, 3)."""
    return SceneArrays(
        m.kind, m.owner, m.kind[:0], m.kind[:0], m.allowed[:0], m.kind[:0], m.allowed, m.rotation, offset, m.size,
        m.place[:0], m.place[:0], m.grid, m.values,
    )  # fmt: skip


@inlined
def place_dynamic(m: DynamicArrays, time: float, offset: Floats) -> None:
    """Put the places of dynamic obstacles at a time [s] into ``offset`` (M, 3)."""
    for o in range(len(m.kind)):
        since = time - m.stamp[o]
        for i in range(3):
            offset[o, i] = m.place[o, i] + since * m.velocity[o, i]


@inlined
def margin_at(m: DynamicArrays, o: int, time: float) -> float:
    """Return the margin of a dynamic obstacle at a time [m]."""
    return float(m.growth[o, 0] + m.growth[o, 1] * max(time - m.stamp[o], 0.0))


@inlined
def relative_shift(m: DynamicArrays, w: Workspace, c: int, o: int, half: float, end: float) -> float:
    """Return how far a cluster's spheres come nearer to a dynamic obstacle, at most, with the margin at the end [m]."""
    x, y, z = half * m.velocity[o, 0], half * m.velocity[o, 1], half * m.velocity[o, 2]
    own = math.sqrt(x * x + y * y + z * z)
    x, y, z = w.linear[c, 0, 0] - x, w.linear[c, 0, 1] - y, w.linear[c, 0, 2] - z
    straight = math.sqrt(x * x + y * y + z * z) + w.remainder[c, 0]
    return float(min(w.arc_bound[c, 0] + own, straight) + margin_at(m, o, end))


@inlined
def _cluster_clear(t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, c: int, o: int, shift: float) -> int:
    """Return -1 where a cluster is proved apart from a dynamic obstacle, or the first of its bodies that is not."""
    # Every comparison is of the form "distance > bound", which is false for NaN.
    if apart(s, o, w.ball[c, 0], w.ball[c, 1], w.ball[c, 2], t.cluster_ball[c, 3] + shift):
        return -1
    first, k = t.cluster_parts[c, 0], bin_of(t, q, c)
    for p in range(first, first + t.cluster_parts[c, 1]):
        if part_clear(t, s, w, c, p, k, o, shift):
            continue
        place_part(t, w, q, p)
        for b in range(t.part_bodies[p, 0], t.part_bodies[p, 0] + t.part_bodies[p, 1]):
            if apart(s, o, w.root[b, 0], w.root[b, 1], w.root[b, 2], t.node_radius[t.body_root[b]] + shift):
                continue
            if not body_clear(t, s, w, b, o, shift) and not is_allowed(s, b, o):
                return int(b)
    return -1


@inlined
def _interval_clear(
    t: RobotArrays, m: DynamicArrays, s: SceneArrays, w: Workspace, q: Floats, half: float, end: float, found: Integers
) -> bool:
    """Whether the motion of ``w`` around a state is proved apart from all obstacles; else the pair is in ``found``."""
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        for o in range(len(m.kind)):
            body = _cluster_clear(t, s, w, q, c, o, relative_shift(m, w, c, o, half, end))
            if body >= 0:
                found[0], found[1] = body, m.owner[o]
                return False
    return True


@inlined
def set_interval(
    t: RobotArrays, knots: Floats, states: Floats, rates: Floats, slack: float, a: float, b: float, q: Floats,
    w: Workspace,
) -> bool:  # fmt: skip
    """Place the robot in the middle of an interval and bound its motion; false where the tables do not hold.

    After the end of the curve the robot stands still.
    """
    last = knots[len(knots) - 1]
    still = len(knots) == 1 or a >= last
    middle = 0.5 * (a + b)
    if still:
        for i in range(len(q)):
            q[i], w.step[i], w.deviation[i], w.half_width[i] = states[len(knots) - 1, i], 0.0, slack, 0.0
    else:
        set_state(knots, states, rates, middle, q)
        set_motion(knots, states, rates, slack, a, b, q, w)
    for i in range(len(q)):
        w.end[i], w.half_width[i] = w.half_width[i], 0.0
    holds = tables_hold(t, q, w.half_width)  # the curve stays inside the limits, also where the box around it does not
    for i in range(len(q)):
        w.half_width[i] = w.end[i]
    if holds:
        place_robot(t, w, q)
        bound_displacements(t, w)
    return holds


@inlined
def conflict_on(
    t: RobotArrays, m: DynamicArrays, s: SceneArrays, w: Workspace, knots: Floats, states: Floats, rates: Floats,
    slack: float, start: float, end: float, clock: float, shortest: float, offset: Floats, state: Floats,
    found: Integers,
) -> float:  # fmt: skip
    """Return the first moment of a motion that is not proved, see :func:`first_conflict`."""
    last = knots[len(knots) - 1]
    found[0] = found[1] = -1
    found[2] = 0
    a, step, halved = start, FIRST, False
    while a < end:
        b = min(a + step, end)
        if a < last < b:
            b = last
        found[2] += 1
        place_dynamic(m, clock + 0.5 * (a + b), offset)
        clear = set_interval(t, knots, states, rates, slack, a, b, state, w)
        if clear:
            clear = _interval_clear(t, m, s, w, state, 0.5 * (b - a), clock + b, found)
        if clear:
            step = (b - a if b < last else step) * (1.0 if halved else LONGER)
            a, halved = b, False
        elif b - a <= shortest:
            return float(a)
        else:
            step, halved = 0.5 * (b - a), True
    return math.inf


@entry_point
def first_conflict(
    ri: Integers, rf: Floats, mi: Integers, mf: Floats, ms: Singles, wi: Integers, wf: Floats,
    knots: Floats, states: Floats, rates: Floats, slack: float,
    start: float, end: float, clock: float, shortest: float, offset: Floats, state: Floats, found: Integers,
) -> float:  # fmt: skip
    """Return the first moment of a motion that is not proved apart from the obstacles [s], or infinity.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        mi: Dynamic obstacles, packed.
        mf: Dynamic obstacles.
        ms: Dynamic obstacles.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        knots: Times of the motion, as are the next three; see :func:`apex_ompl.kernel.compiled.check.curve.set_motion`.
        states: States at the knots.
        rates: Velocities and accelerations at the knots.
        slack: What the pieces miss each other by.
        start: Where on the motion to start [s].
        end: Where to end [s]; after its last knot the robot stands still.
        clock: Time of the dynamic obstacles' stamps when the motion is at 0 [s].
        shortest: Length of an interval that is not divided further [s].
        offset: Buffer for places, shape (M, 3).
        state: Buffer for a state, shape (dof,).
        found: Gets the body and the owner of the dynamic obstacle, shape (2,); then the number of intervals.
    """
    t, m = robot_view(ri, rf), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    s = scene_of_dynamic(m, offset)
    return float(
        conflict_on(
            t, m, s, w, knots, states, rates, slack, start, end, clock, shortest, offset, state, found
        )
    )  # fmt: skip


@inlined
def nearest_dynamic_obstacle(
    t: RobotArrays, m: DynamicArrays, s: SceneArrays, w: Workspace, q: Floats, time: float, limit: float
) -> Nearest:
    """Return the nearest leaf and dynamic obstacle, less margins, that are less than ``limit`` apart."""
    best = (limit, -1, -1, -1, -1)
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        for o in range(len(m.kind)):
            margin = margin_at(m, o, time)
            near = nearest_to_obstacle(t, s, w, q, c, o, (best[0] + margin, -1, -1, -1, -1))
            if near[1] >= 0:
                best = (near[0] - margin, near[1], near[2], near[3], near[4])
    return best


@inlined
def _closing_speed(t: RobotArrays, m: DynamicArrays, s: SceneArrays, w: Workspace, near: Nearest, time: float) -> float:
    """Return the derivative of a leaf's clearance to a dynamic obstacle with respect to the time alone [m/s]."""
    o = near[3]
    x, y, z = node_position(t, w, t.body_joint[near[1]], near[2])
    u = direction(s, o, x, y, z)
    v = m.velocity[o]
    growing = m.growth[o, 1] if time > m.stamp[o] else 0.0
    return float(-(u[0] * v[0] + u[1] * v[1] + u[2] * v[2]) - growing)


@entry_point
def clearances_in_time(
    ri: Integers, rf: Floats, mi: Integers, mf: Floats, ms: Singles, wi: Integers, wf: Floats,
    states: Floats, times: Floats, limit: float, offset: Floats, values: Floats, gradients: Floats,
) -> None:  # fmt: skip
    """Put the signed clearances of states, shape (N, dof), to dynamic obstacles at times (N,) into ``values`` (N,) [m].

    Clearances above ``limit`` are given as ``limit``, with gradient 0. ``gradients``, shape (N, dof + 1), gets the
    gradients with respect to the state, and the derivative with respect to the time; shape (0, dof + 1) asks for none.
    States for which the tables do not hold get NaN.
    """
    t, m = robot_view(ri, rf), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    s = scene_of_dynamic(m, offset)
    dof = states.shape[1]
    for k in range(len(states)):
        q = states[k]
        if not tables_hold(t, q, w.half_width):
            values[k] = math.nan
            if len(gradients):
                for i in range(dof + 1):
                    gradients[k, i] = math.nan
            continue
        place_robot(t, w, q)
        place_dynamic(m, times[k], offset)
        near = nearest_dynamic_obstacle(t, m, s, w, q, times[k], limit)
        values[k] = near[0]
        if len(gradients):
            for i in range(dof + 1):
                gradients[k, i] = 0.0
            if near[1] >= 0:
                gradient_to_obstacle(t, s, w, near, gradients[k, :dof])
                gradients[k, dof] = _closing_speed(t, m, s, w, near, times[k])
