"""Stops from a motion at many of its times, proved against everything that dynamic obstacles can have reached."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import (
    DynamicArrays,
    conflict_on,
    dynamic_view,
    scene_of_dynamic,
)
from apex_ompl.kernel.compiled.moving.stops import SAME_TIME, set_place, soonest_stop, soonest_stops
from apex_ompl.kernel.compiled.workspace import workspace_view


@inlined
def _set_curve(count: int, out: Floats, states: Floats, rates: Floats) -> None:
    """Put the states at knots, shape (3, K, dof), into the arrays of a curve."""
    dof = states.shape[1]
    for k in range(count):
        for i in range(dof):
            states[k, i], rates[k, i], rates[k, dof + i] = out[0, k, i], out[1, k, i], out[2, k, i]


@inlined
def _stop_by_joints(
    start: Floats, lower: Floats, upper: Floats, acceleration: Floats, jerk: Floats, phases: Floats, times: Floats,
    out: Floats, beyond: Floats,
) -> int:  # fmt: skip
    """Stop each joint by itself; return the number of knots, or -1 where one passes a position limit."""
    count = soonest_stops(
        start[0], start[1], start[2], lower, upper, acceleration, jerk, phases[0], phases[1], times, out, beyond
    )
    for i in range(len(beyond)):
        if beyond[i] != 0.0:
            return -1
    return int(count)


@inlined
def _show_dynamic(m: DynamicArrays, place: Floats, velocity: Floats, stamp: Floats, seen: float) -> None:
    """Let dynamic obstacles stand where they are expected at a time, and have been seen then."""
    for o in range(len(stamp)):
        m.stamp[o] = seen
        for i in range(3):
            m.place[o, i] = place[o, i] + (seen - stamp[o]) * velocity[o, i]
            m.velocity[o, i] = 0.0


@entry_point
def first_unproved_stop(
    ri: Integers, rf: Floats, mi: Integers, mf: Floats, ms: Singles, wi: Integers, wf: Floats,
    place: Floats, velocity: Floats, stamp: Floats, age: float,
    knots: Floats, states: Floats, rates: Floats, slack: float, motion: Floats,
    lower: Floats, upper: Floats, fastest: Floats, acceleration: Floats, jerk: Floats, allowed: float,
    moments: Floats, by_joints: Integers, period: float, clock: float, shortest: float,
    offset: Floats, state: Floats, found: Integers, start: Floats, control: Floats, here: Floats, deviation: Floats,
    phases: Floats, times: Floats, out: Floats, stopped: Floats, stopped_rates: Floats,
) -> int:  # fmt: skip
    """Return which of some moments is the first after which no stop is proved, or their number.

    At each, the dynamic obstacles were seen ``age`` before, where they are expected then, and may have gone anywhere
    since as far as their margins say, which are those of ``mf``. The next ``period`` of the motion is proved, then the
    soonest stop along it, which is that of :func:`apex_ompl.kernel.compiled.moving.stops.stop_on_path`, or else that of
    each joint by itself, of :func:`apex_ompl.kernel.compiled.moving.stops.stop_joints`. What stands still, and the
    robot itself, are ignored.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        mi: Dynamic obstacles, packed; places, velocities and stamps are written to.
        mf: Dynamic obstacles.
        ms: Dynamic obstacles.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        place: Where the dynamic obstacles are expected at their stamps, shape (M, 3) [m].
        velocity: Their velocities, shape (M, 3) [m/s].
        stamp: Their stamps, shape (M,) [s].
        age: How long before a moment they were seen [s].
        knots: Times of the motion, as are the next three; see :func:`apex_ompl.kernel.compiled.check.curve.set_motion`.
        states: States at the knots.
        rates: Velocities and accelerations at the knots.
        slack: Sum of the gaps between the pieces.
        motion: Positions, velocities and accelerations at the knots, shape (3, K, dof).
        lower: Lowest positions of stops, shape (dof,) [rad].
        upper: Highest positions, shape (dof,) [rad].
        fastest: Limits of velocity, shape (dof,) [rad/s].
        acceleration: Limits of acceleration, shape (dof,) [rad/s^2].
        jerk: Limits of jerk, shape (dof,) [rad/s^3].
        allowed: Largest distance of any joint from the path [rad].
        moments: Times of the motion, shape (N,) [s].
        by_joints: Gets whether the stop is that of each joint by itself, shape (N,).
        period: Time from a moment to the stop [s].
        clock: Time of the dynamic obstacles' stamps when the motion is at 0 [s].
        shortest: Length of an interval that is not divided further [s].
        offset: Buffer for places, shape (M, 3).
        state: Buffer, shape (dof,).
        found: Buffer, shape (3,).
        start: Buffer, shape (3, dof).
        control: Buffer, shape (MOST_STEPS + 4, dof).
        here: Buffer, shape (dof,).
        deviation: Buffer, shape (dof,).
        phases: Buffer, shape (2, dof, PHASES).
        times: Buffer for the knots of a stop, shape (R,).
        out: Buffer, shape (3, R, dof).
        stopped: Buffer, shape (R, dof).
        stopped_rates: Buffer, shape (R, 2 dof).
    """
    t, m = robot_view(ri, rf), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    s = scene_of_dynamic(m, offset)
    end = knots[len(knots) - 1]
    for n in range(len(moments)):
        then = moments[n] + period
        _show_dynamic(m, place, velocity, stamp, clock + moments[n] - age)
        resting, proved = then >= end - SAME_TIME, False
        by_joints[n] = 0
        for kind in range(3):  # the next period of the motion, the stop along it, that of each joint
            at, curve, curve_rates, since, until, zero, count = knots, states, rates, moments[n], then, clock, 0
            if kind == 0 and resting:
                until = end
            if kind == 1:
                since, until = then, end
                count = soonest_stop(
                    knots, motion, then, start, lower, upper, fastest, acceleration, jerk, allowed, control, here,
                    deviation, times, out,
                )  # fmt: skip
            if kind == 2:
                set_place(knots, motion, then, start)
                count = _stop_by_joints(start, lower, upper, acceleration, jerk, phases, times, out, deviation)
                if count < 0:
                    break
                by_joints[n] = 1
            if count > 0:  # else the rest of the motion is as soon
                _set_curve(count, out, stopped, stopped_rates)
                at, curve, curve_rates = times[:count], stopped[:count], stopped_rates[:count]
                since, until, zero = 0.0, times[count - 1], clock + then
            clear = conflict_on(
                t, m, s, w, at, curve, curve_rates, slack, since, until, zero, shortest, offset, state, found
            )  # fmt: skip
            if kind == 0 and (resting or not clear == math.inf):
                proved = clear == math.inf
                break
            if kind > 0 and clear == math.inf:
                proved = True
                break
        if not proved:
            return n
    return len(moments)
