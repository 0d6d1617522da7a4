"""Blended motions: cubic B-splines in time along a curve that rounds the corners of a polyline."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from apex_ompl.errors import TimingError
from apex_ompl.kernel.timing import arc_lengths, curve_duration, max_distance, max_path_speeds
from apex_ompl.robot.model import Limits
from apex_ompl.timing.curve import Curve, Polyline, deviation_bound
from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array

GRID_POINTS_PER_SPAN = 10
MAX_SPANS = 20_000
CONTROL_POINT_SPACING = 3.0  # of the curve, as a multiple of the deviation: a corner is cut by a third of the spacing
KNOT_SPACINGS = tuple(k * 2**n / 240 for n in range(11) for k in (1, 1.5))  # in time, from 0.0042 to 6.4 [s]
FIRST_SPACING = 4  # index of the knot spacing that is tried first; smaller ones where they keep the deviation
SAME_DURATION = 1.0005  # ratio of durations below which the motion with fewer knots is preferred
NANOSECOND = 1e-9
LONGEST = 3600.0
"""Longest motion that is timed [s]."""


class Blend(NamedTuple):
    """Motion along a curve that rounds the corners of a polyline.

    Attributes:
        trajectory: The motion.
        deviation: A bound on its distance from the polyline [rad].
        arc_at: Times of its knots, shape (K,) [s], and the arc lengths along the polyline that it reaches at them,
            shape (K,) [rad]; for :func:`apex_ompl.timing.curve.deviation_bound`.
        window: Largest distance along the polyline from there to the nearest point [rad].
    """

    trajectory: Trajectory
    deviation: float
    arc_at: tuple[Array, Array]
    window: float


def blended(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], deviation: float,
    stop: Callable[[], bool] = lambda: False, *, more: MotionLimits | None = None,
) -> tuple[Trajectory, float, str] | None:  # fmt: skip
    """Return the motion of :func:`blend`, a bound on its distance from the polyline [rad], and ``spline``, or None."""
    found = blend(line, limits, joint_names, deviation, stop, more=more)
    return None if found is None else (found.trajectory, found.deviation, "spline")


def blend(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], deviation: float,
    stop: Callable[[], bool] = lambda: False, *, more: MotionLimits | None = None,
) -> Blend | None:  # fmt: skip
    """Return the fastest motion along a curve that rounds the corners of a polyline.

    1. A uniform cubic B-spline q(s) along the polyline rounds its corners (:class:`apex_ompl.timing.curve.Curve`).
    2. Reachability analysis gives the largest speeds along q(s) within the limits of velocity and acceleration
       (:func:`apex_ompl.kernel.timing.max_path_speeds`; Pham and Pham 2018).
    3. States at times h apart on that motion are the control points of a uniform cubic B-spline in time. Averages of
       states within the limits are within the limits, and the jerk is at most 2 a_max / h. In step 2 the limit of
       acceleration is min(a_max, j_max h); h is stretched where a limit is still exceeded.
    4. The h with the shortest motion is chosen, or the next smaller one that keeps the deviation.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        deviation: Largest distance of the motion from the polyline [rad].
        stop: Called before every knot spacing; True ends the search.
        more: Limits of torques and tool speeds, which count in step 2; the spline in time may exceed them a little.

    Returns:
        The motion, or None where none keeps ``deviation``, or when ``stop`` returned True.

    Raises:
        TimingError: It would take longer than ``LONGEST``.
    """
    if line.length > MAX_SPANS * CONTROL_POINT_SPACING * deviation:
        return None
    curve = Curve.along(line, CONTROL_POINT_SPACING * deviation)
    first, second = curve.derivatives(GRID_POINTS_PER_SPAN)
    step, window = curve.spacing / GRID_POINTS_PER_SPAN, 2.0 * curve.spacing
    grid = np.linspace(0.0, line.length, len(first))
    if max_distance(curve.points(grid), grid, line.states, line.arc, window) > deviation:
        return None
    rows = None if more is None else more.rows(curve.points(grid), first, second)
    tried: dict[int, tuple[float, Array, Array]] = {}  # least knot spacing [s], control points, their arc lengths

    def duration_with(index: int) -> float:
        """Return the duration of the motion with a knot spacing by its index, and keep the motion in ``tried``."""
        if index not in tried:
            spacing = KNOT_SPACINGS[index]
            acceleration = np.minimum(limits.acceleration, limits.jerk * spacing)
            squared_speeds = max_path_speeds(first, second, limits.velocity, acceleration, step, rows)
            duration = curve_duration(squared_speeds, step)
            if duration > LONGEST:
                raise TimingError(f"it would take {duration:.6g} s, more than {LONGEST:g} s")
            count = max(1, int(duration / spacing))
            arc = arc_lengths(squared_speeds, step, duration / count, count + 1)
            arc[-1] = line.length
            points = curve.points(arc)
            points[0], points[-1] = line.states[0], line.states[-1]
            control = np.concatenate([points[:1], points[:1], points, points[-1:], points[-1:]])
            least = least_knot_spacing(control, limits)
            tried[index] = (least if rows is None else max(least, duration / count), control, arc)
        least, control, _ = tried[index]
        return least * (len(control) - 3) if least > 0.0 else math.inf  # 0 at the ends of a closed path

    best = FIRST_SPACING
    while (
        not stop() and best + 1 < len(KNOT_SPACINGS) and duration_with(best + 1) < SAME_DURATION * duration_with(best)
    ):
        best += 1
    for index in range(best, -1, -1):  # knots far apart in time cut corners of the curve
        if stop():
            return None
        duration_with(index)
        spacing, control, arc = tried[index]
        if spacing == 0.0:
            continue
        motion = spline_in_time(control, spacing, joint_names)
        low, high = line.states.min(axis=0), line.states.max(axis=0)  # the spline is inside, except for rounding
        motion = replace(motion, positions=motion.positions.clip(low, high))
        arc = np.concatenate([[0.0], arc, [line.length]])
        bound = deviation_bound(motion, line, (motion.times, arc), window, deviation, stop=stop)
        if bound <= deviation:
            return Blend(motion, bound, (motion.times, arc), window)
    return None


def least_knot_spacing(control: Array, limits: Limits) -> float:
    """Return the least knot spacing h at which a uniform cubic B-spline in time keeps the limits [s].

    With control points P_i, velocities are convex combinations of the first differences dP / h; accelerations at the
    knots are d2P / h^2, and jerks between them d3P / h^3. So h = max_k max |dkP / limit_k|^(1/k).
    """
    least = []
    difference = control
    for order, limit in enumerate((limits.velocity, limits.acceleration, limits.jerk), 1):
        difference = np.diff(difference, axis=0)
        least.append(float(np.abs(difference / limit).max(initial=0.0)) ** (1.0 / order))
    return whole_nanoseconds(max(least) * (1.0 + 1e-9))


def whole_nanoseconds(time: float) -> float:
    """Return a time rounded up to whole nanoseconds, the resolution of messages [s]."""
    return NANOSECOND * float(math.ceil(time / NANOSECOND))


def spline_in_time(
    control: Array, spacing: float, joint_names: tuple[str, ...], start: tuple[Array, Array, Array] | None = None
) -> Trajectory:
    """Return the uniform cubic B-spline in time with control points of shape (K + 2, dof) and a knot spacing [s].

    It ends at rest in the last control point, which is given three times. It starts at rest in the same way, or with
    the position, velocity and acceleration of ``start``, which determine the first three control points
    (:func:`start_points`). Both ends are exact.
    """
    before, at, after = control[:-2], control[1:-1], control[2:]
    positions = (before + 4.0 * at + after) / 6.0
    velocities, accelerations = (after - before) / (2.0 * spacing), (after - 2.0 * at + before) / spacing**2
    positions[0], positions[-1] = control[0], control[-1]
    if start is not None:
        positions[0], velocities[0], accelerations[0] = start
    times = np.arange(len(positions), dtype=float) * spacing
    return Trajectory(times, positions, velocities, accelerations, joint_names)


def start_points(start: tuple[Array, Array, Array], spacing: float) -> Array:
    """Return the first three control points of a uniform cubic B-spline in time with a given start.

    They solve (c_0 + 4 c_1 + c_2) / 6 = q, (c_2 - c_0) / 2h = v and (c_0 - 2 c_1 + c_2) / h^2 = a.

    Args:
        start: Position q, velocity v and acceleration a, each of shape (dof,).
        spacing: Knot spacing h [s].
    """
    q, v, a = start
    middle = q - a * spacing**2 / 6.0
    mean = middle + a * spacing**2 / 2.0
    return np.stack([mean - v * spacing, middle, mean + v * spacing])
