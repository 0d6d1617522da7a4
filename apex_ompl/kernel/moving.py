"""Motions among dynamic obstacles: proofs and clearances in time, blocked intervals, stops, speeds and optimization.

Dynamic obstacles come as :class:`apex_ompl.kernel.arrays.DynamicArrays`, packed. Times of their stamps are those of a
clock; a motion has its own time, which is 0 at its start.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from apex_ompl.kernel.arrays import DynamicArrays
from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.moving import (
    blocked_intervals as compiled_intervals,
)
from apex_ompl.kernel.compiled.moving import (
    dynamic_obstacles,
    motion_optimization,
    speed_profile,
    speed_search,
    stop_proof,
    stops,
)
from apex_ompl.kernel.curve_proof import CurveArrays
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.path import CostSettings, PathGrid, PathReport, optimization_buffers
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact

Packed = tuple[Any, ...]
"""Packed dynamic obstacles."""

SAMPLE_WIDTH = motion_optimization.WIDTH  # control points of a spline in time that a sample depends on
MOST_SPANS = compiled_intervals.MOST_SPANS  # blocked intervals of a place


class LimitArrays(NamedTuple):
    """Limits of joints, each of shape (dof,): positions [rad], velocity, acceleration and jerk [rad/s^k]."""

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    @classmethod
    def of(cls, limits: Any) -> LimitArrays:
        """Return the limits of an object with these attributes as contiguous arrays."""
        return cls(*(compact(getattr(limits, name)) for name in cls._fields))

    def scaled(self, share: float) -> LimitArrays:
        """Return the same limits with a share of the accelerations and jerks."""
        return self._replace(acceleration=share * self.acceleration, jerk=share * self.jerk)


class OpenMoment(NamedTuple):
    """First moment of a motion that is not proved.

    Attributes:
        time: Time of the motion [s]; infinite where all of it is proved.
        body: Row of the body that is not proved apart, -1 for none.
        dynamic_obstacle: Number of the dynamic obstacle.
        intervals: Number of intervals of time examined.
    """

    time: float
    body: int
    dynamic_obstacle: int
    intervals: int


def first_conflict(
    kernel: Kernel, dynamic: Packed, curve: CurveArrays, start: float, end: float, clock: float, shortest: float
) -> OpenMoment:
    """Prove by the sphere cover that a motion stays apart from dynamic obstacles, up to the first open moment.

    Args:
        kernel: The robot; its scene is ignored.
        dynamic: The obstacles.
        curve: The cubic pieces of the motion; after its end the robot stands still.
        start: Where on the motion to start [s].
        end: Where to end [s].
        clock: Time of the obstacles' stamps when the motion is at 0 [s].
        shortest: Length of an interval of time that is not divided further [s].
    """
    found = np.empty(3, np.int64)
    time = dynamic_obstacles.first_conflict(
        *kernel.robot.packed, *dynamic, *kernel.workspace(), curve.knots, curve.states, curve.rates, curve.slack,
        float(start), float(end), float(clock), float(shortest), _places(dynamic), np.empty(kernel.robot.dof), found,
    )  # fmt: skip
    return OpenMoment(float(time), *found.tolist())


def clearances_in_time(
    kernel: Kernel, dynamic: Packed, states: Array, times: Array, limit: float
) -> tuple[Array, Array]:
    """Return the signed clearances of the sphere cover to dynamic obstacles, and their gradients.

    Args:
        kernel: The robot; its scene is ignored.
        dynamic: The obstacles.
        states: Shape (N, dof).
        times: Times of the obstacles' stamps, shape (N,) [s].
        limit: Larger clearances are given as this [m].

    Returns:
        Values, shape (N,) [m], and gradients with respect to state and time, shape (N, dof + 1) [m/rad, m/s].
    """
    values, gradients = np.empty(len(states)), np.empty((len(states), states.shape[1] + 1))
    dynamic_obstacles.clearances_in_time(
        *kernel.robot.packed, *dynamic, *kernel.workspace(), states, times, float(limit), _places(dynamic), values,
        gradients,
    )  # fmt: skip
    return values, gradients


def blocked_intervals(
    kernel: Kernel, dynamic: Packed, curve: CurveArrays, places: Array, window: tuple[float, float], slack: float
) -> tuple[Array, Integers]:
    """Find the times at which dynamic obstacles block pieces of a path, by the sphere cover: never too short.

    Args:
        kernel: The robot; its scene is ignored.
        dynamic: The obstacles.
        curve: The path.
        places: Parameters of the starts and ends of the pieces in order, shape (P, 2); the same twice for one state.
        window: First and last time that are examined, of the obstacles' stamps [s].
        slack: Distance from the path, of each joint, within which states count as being on it [rad].

    Returns:
        The intervals of each piece in order, shape (P, most, 2) [s], and their numbers, shape (P,).
    """
    spans = np.zeros((len(places), MOST_SPANS, 2))
    counts, (start, end) = np.empty(len(places), np.int64), window
    compiled_intervals.blocked_intervals(
        *kernel.robot.packed, *dynamic, *kernel.workspace(), curve.knots, curve.states, curve.rates,
        curve.slack + slack, places, float(start), float(end), np.empty(kernel.robot.dof), spans, counts,
    )  # fmt: skip
    return spans, counts


def stop_joints(
    position: Array, velocity: Array, acceleration: Array, limits: LimitArrays
) -> tuple[Array, Array, Array]:
    """Stop every joint as soon as it can, each by itself.

    Args:
        position: Shape (dof,) [rad].
        velocity: Shape (dof,) [rad/s].
        acceleration: Shape (dof,) [rad/s^2].
        limits: Limits; that of velocity is ignored.

    Returns:
        Times at which the jerk of any joint changes, shape (K,) [s], positions, velocities and accelerations at them,
        shape (3, K, dof), and how far each joint passes a position limit, shape (dof,) [rad].
    """
    dof = len(position)
    lengths, jerks, beyond = np.empty((dof, stops.PHASES)), np.empty((dof, stops.PHASES)), np.empty(dof)
    times, knots = np.empty(dof * stops.PHASES + 2), np.empty((3, dof * stops.PHASES + 2, dof))
    count = stops.stop_joints(
        compact(position), compact(velocity), compact(acceleration), limits.lower, limits.upper, limits.acceleration,
        limits.jerk, lengths, jerks, times, knots, beyond,
    )  # fmt: skip
    return times[:count], knots[:, :count], beyond


def stop_on_path(
    times: Array, states: Array, time: float, limits: LimitArrays, deviation: float
) -> tuple[Array, Array, float] | None:
    """Find the soonest stop along the path of a motion that ends at rest; None where none ends before the motion.

    Args:
        times: Times of the motion, shape (K,) [s].
        states: Positions, velocities and accelerations at them, shape (3, K, dof).
        time: Time from which it stops [s].
        limits: Limits of the stop.
        deviation: Largest distance of any joint from the path [rad].

    Returns:
        Times of the knots, shape (N,) [s], the states at them, shape (3, N, dof), and a bound on the distance of the
        joints from the path [rad].
    """
    dof, room = states.shape[2], len(times) + stops.MOST_STEPS + 4
    start, control, work = np.empty((3, dof)), np.empty((stops.MOST_STEPS + 4, dof)), np.empty((2, dof))
    made, knots = np.empty(room), np.empty((3, room, dof))
    count = stops.stop_on_path(
        compact(times), states, time, start, *limits, deviation, control, *work, made, knots
    )  # fmt: skip
    return (made[:count], knots[:, :count], float(work[1].max())) if count else None


class StopSeries(NamedTuple):
    """Stops from a motion at many of its moments, among obstacles that may go anywhere after they were seen.

    Attributes:
        expected: The obstacles as they are expected to move.
        seen: The same, packed, with the margins of what was seen; places, velocities and stamps are written to.
        age: Time from when they were seen to a moment [s].
        curve: The cubic pieces of the motion.
        states: Positions, velocities and accelerations at its knots, shape (3, K, dof).
        limits: Limits of stops.
        deviation: Largest distance of any joint from the path [rad].
        moments: Times of the motion, shape (N,) [s].
        period: Time from a moment to the stop [s].
        clock: Time of the obstacles' stamps when the motion is at 0 [s].
        shortest: Length of an interval of time that is not divided further [s].
    """

    expected: DynamicArrays
    seen: Packed
    age: float
    curve: CurveArrays
    states: Array
    limits: LimitArrays
    deviation: float
    moments: Array
    period: float
    clock: float
    shortest: float


def first_unproved_stop(kernel: Kernel, series: StopSeries) -> tuple[int, Flags]:
    """Return the first moment after which no stop is proved, or the number of moments, and which stops are by joint.

    The next period of the motion is proved, then the soonest stop along it, or else that of each joint by itself. What
    stands still, and the robot itself, are ignored.
    """
    s, curve = series, series.curve
    dof, knots, solids = s.states.shape[2], len(curve.knots), len(s.expected.kind)
    room = max(knots + stops.MOST_STEPS + 4, dof * stops.PHASES + 2)
    by_joints = np.zeros(len(s.moments), np.int64)
    count = stop_proof.first_unproved_stop(
        *kernel.robot.packed, *s.seen, *kernel.workspace(), s.expected.place, s.expected.velocity, s.expected.stamp,
        float(s.age), curve.knots, curve.states, curve.rates, curve.slack, s.states, *s.limits, s.deviation,
        compact(s.moments), by_joints, float(s.period), float(s.clock), s.shortest, np.empty((solids, 3)),
        np.empty(dof), np.empty(3, np.int64), np.empty((3, dof)), np.empty((stops.MOST_STEPS + 4, dof)), np.empty(dof),
        np.empty(dof), np.empty((2, dof, stops.PHASES)), np.empty(room), np.empty((3, room, dof)),
        np.empty((room, dof)), np.empty((room, 2 * dof)),
    )  # fmt: skip
    return int(count), by_joints.astype(bool)


def push_bounds(rates: Array, limits: LimitArrays, spacing: float, window: float, x: Array) -> tuple[Array, Array]:
    """Return the least and largest d^2s/dt^2 at places of a path for each level of x = (ds/dt)^2, (P, levels) [1/s].

    Args:
        rates: q' and q'' at the places, shape (2, P, dof).
        limits: Limits of velocity, acceleration and jerk.
        spacing: Spacing of the places [s].
        window: Time in which d^2s/dt^2 may change at the largest jerk [s].
        x: Levels of the squared rate, shape (levels,).
    """
    lowest, highest = np.empty((2, rates.shape[1], len(x)))
    speed_profile.push_bounds(
        rates, limits.velocity, limits.acceleration, limits.jerk, spacing, window, x, lowest, highest
    )
    return lowest, highest


class SpeedSearch(NamedTuple):
    """A search of the profile of speed along a path that arrives first among blocked intervals of time.

    The path has S stages of ``pieces`` pieces each; levels are those of x = (ds/dt)^2.

    Attributes:
        spans: Blocked intervals of the pieces, shape (S pieces, most, 2) [s].
        counts: Their numbers, shape (S pieces,).
        point_spans: Blocked intervals of the points between stages, shape (S + 1, most, 2) [s].
        point_counts: Their numbers, shape (S + 1,).
        lowest: Least d^2s/dt^2 at the ends of pieces, shape (S pieces + 1, levels) [1/s].
        highest: Largest d^2s/dt^2, shape (S pieces + 1, levels) [1/s].
        x: Levels, increasing from 0, shape (levels,).
        length: Length of a stage in the motion's own time [s].
        own: Level of the motion's own rate, x = 1.
        rests: Whether it starts at rest.
        forced: Number of stages at the start that keep the motion's own rate.
        start: Time at the start [s].
        latest: Last time at the end [s].
        hold: Time for which the end must stay free after the arrival [s].
        pieces: Pieces of a stage.
    """

    spans: Array
    counts: Integers
    point_spans: Array
    point_counts: Integers
    lowest: Array
    highest: Array
    x: Array
    length: float
    own: int
    rests: bool
    forced: int
    start: float
    latest: float
    hold: float
    pieces: int


def earliest_arrivals(search: SpeedSearch) -> tuple[Integers, Array] | None:
    """Return the profile that arrives first, or None.

    Returns:
        Levels at the points between stages, shape (S + 1,), and the times at which it arrives at and leaves them, shape
        (S + 1, 2) [s].
    """
    points, most = len(search.point_counts), speed_search.MOST_TIMES
    levels, departures = np.empty(points, np.int64), np.empty((points, 2))
    found = speed_search.earliest_arrivals(
        *search[:-1], np.empty((points, len(search.x), most, 2)), np.empty((points, len(search.x)), np.int64),
        np.empty((points, most, 2)), np.empty(points, np.int64), np.empty((4 * most, 2)), np.empty(search.pieces + 1),
        levels, departures,
    )  # fmt: skip
    return (levels, departures) if found else None


def profile_places(
    x: Array, length: float, first: float, profile: tuple[Integers, Array], start: float, spacing: float, count: int
) -> Array:
    """Return the places of a profile at evenly spaced times, shape (count,) [s].

    Args:
        x: Levels of the squared rate, shape (levels,).
        length: Length of a stage [s].
        first: Place of the first point [s].
        profile: Levels and departures of :func:`earliest_arrivals`.
        start: First time [s].
        spacing: Spacing of the times [s].
        count: Number of places.
    """
    places = np.empty(count)
    speed_profile.profile_places(x, length, first, *profile, start, spacing, places)
    return places


def follow_profile(
    times: Array, states: Array, place: float, places: Array, spacing: float, limits: LimitArrays
) -> tuple[Array, Array, Array] | None:
    """Make the motion along a path that has the places of a profile, or return None where it breaks a limit.

    Args:
        times: The path's own times, shape (K,) [s].
        states: Positions, velocities and accelerations at them, shape (3, K, dof).
        place: Place at the start, which is passed at rate 1 or at rest [s].
        places: Places at evenly spaced times, the last at rest, shape (N + 1,), N > 1 [s].
        spacing: Spacing of these times [s].
        limits: Limits of the motion.

    Returns:
        Times of its knots, shape (N + 2,) [s], the states at them, shape (3, N + 2, dof), and the largest distance of
        each joint at its knots from the places of the profile, shape (dof,) [rad].
    """
    dof, size = states.shape[2], len(places) + 1
    control, deviation, made, out = np.empty((size + 2, dof)), np.empty(dof), np.empty(size), np.empty((3, size, dof))
    count = speed_profile.follow_profile(
        compact(times), states, float(place), places, spacing, *limits, np.empty((3, dof)), control, deviation, made,
        out,
    )  # fmt: skip
    return (made, out, deviation) if count else None


class BlockedPlaces(NamedTuple):
    """Places along a path and the intervals of time in which they are blocked.

    Attributes:
        places: Starts and ends of the pieces of the path, shape (P, 2) [s].
        spans: Their blocked intervals, shape (P, most, 2) [s].
        counts: Numbers of these, shape (P,).
        points: Single places, increasing, shape (S + 1,) [s].
        point_spans: Their blocked intervals, shape (S + 1, most, 2) [s].
        point_counts: Numbers of these, shape (S + 1,).
    """

    places: Array
    spans: Array
    counts: Integers
    points: Array
    point_spans: Array
    point_counts: Integers


def first_blocked(blocked: BlockedPlaces, places: Array, start: float, spacing: float) -> int:
    """Return the first step of a profile in which it may be at a place that is blocked, or -1.

    Args:
        blocked: Places and their intervals.
        places: Places of the profile at evenly spaced times, shape (N,) [s].
        start: Time of the first [s].
        spacing: Spacing of the times [s].
    """
    return int(speed_profile.first_blocked(*blocked, places, float(start), spacing))


class MotionCost(NamedTuple):
    """Cost of a uniform cubic B-spline in time, see :mod:`apex_ompl.kernel.compiled.moving.motion_optimization`.

    Attributes:
        grid: Weights of the control points at N samples, and the matrix of the speed.
        times: Times of the samples by the obstacles' clock, shape (N,) [s].
        limits: Limits of velocity, acceleration and jerk times the knot spacing, its square and cube, shape (3, dof).
        limit_weight: Weight of half the square of what they are exceeded by, as a share.
        settings: Margins, stiffness and steps.
        given: Values at the samples of joints that follow a given motion, NaN of all others, shape (N, dof); without
            such joints (0, dof).
    """

    grid: PathGrid
    times: Array
    limits: Array
    limit_weight: float
    settings: CostSettings
    given: Array


def optimize_motion(
    kernel: Kernel, dynamic: Packed, cost: MotionCost, pinned: int, control: Array, slopes: int = 0
) -> tuple[PathReport, Array]:
    """Improve a motion in place by Levenberg-Marquardt steps.

    Args:
        kernel: The robot in its scene.
        dynamic: Dynamic obstacles.
        cost: The cost.
        pinned: Number of control points at each end that stay.
        control: Control points, shape (P, dof); the free ones are put inside the limits.
        slopes: Length of the gradient, or 0 for none.

    Returns:
        The report, and the gradient where no steps are asked for, shape (slopes,).
    """
    slope = np.empty(slopes)
    report = motion_optimization.optimize_motion(
        *kernel.packed, *dynamic, *kernel.workspace(), _places(dynamic), *cost.grid, cost.times, cost.limits,
        float(cost.limit_weight), compact(cost.given), pinned, control, tuple(cost.settings),
        *optimization_buffers(pinned, *control.shape), slope,
    )  # fmt: skip
    return PathReport(*report), slope


def _places(dynamic: Packed) -> Array:
    """Return room for the places of the solids of dynamic obstacles, shape (M, 3)."""
    integers = dynamic[0]  # start with the first and last place of their kinds
    return np.empty((int(integers[1] - integers[0]), 3))
