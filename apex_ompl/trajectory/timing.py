"""Time parameterisation: from a path to a motion within limits of velocity, acceleration and jerk."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError, TimingError
from apex_ompl.kernel.compiled.polyline_distance import max_distance
from apex_ompl.kernel.compiled.time_parameterization import max_path_speeds, sample_times
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.curve import SAME, Curve, Polyline
from apex_ompl.trajectory.motion import Trajectory
from apex_ompl.trajectory.point_to_point import from_motion, stops
from apex_ompl.types import Array
from apex_ompl.util.validation import is_number, numbers

PER_PIECE = 10  # points of the grid a piece of the curve
SPACINGS = tuple(0.001 * k * 2**n for n in range(2, 13) for k in (1, 1.5))  # of knots, from 0.004 to 6.144 [s]
LITTLE = 1.0005  # longer a motion may be for fewer knots
FASTER = 1.1  # than at the knots it may be between them
MOST_SAMPLES, MOST_PIECES = 100_000, 20_000
INSTANT = 1e-3  # that a motion takes between states that are as good as the same [s]
SPACING = 3.0  # of control points, as a multiple of the deviation; a corner is cut by a third
FIRST = 4  # of the spacings of knots, that is tried first [s]
CLOSER = 6  # times that the blending of corners is halved before the motion stops at them
OUTSIDE = 1e-9  # of the limits of position a path may be, by rounding
NANOSECOND = 1e-9
RANGES = {
    **dict.fromkeys(("velocity_scale", "acceleration_scale", "jerk_scale"), (1e-3, 1.0)),
    "deviation": (1e-3, 10.0), "minimum_duration": (0.0, 3600.0),
}  # fmt: skip


@dataclass(frozen=True)
class Timing:
    """How a path is timed.

    Attributes:
        velocity_scale: Share of the limits of velocity that is used, 0.001 to 1.
        acceleration_scale: The same of acceleration.
        jerk_scale: The same of jerk.
        deviation: Largest distance of the motion from the path, 0.001 to 10 [rad, Euclidean; synergies 0..1]; a motion
            from a moving start may leave it by more, as little as can be.
        minimum_duration: The motion takes at least so long, up to 3600 [s].
        start_velocity: Velocity at the start, one number a joint, or none for rest [rad/s].
        start_acceleration: Acceleration there [rad/s^2].
    """

    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    jerk_scale: float = 1.0
    deviation: float = 0.05
    minimum_duration: float = 0.0
    start_velocity: Sequence[float] = ()
    start_acceleration: Sequence[float] = ()

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: One is out of its range.
        """
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if not is_number(value) or not low <= value <= high:
                raise ParameterError(name, value, f"a number from {low:g} to {high:g}")
        for name in ("start_velocity", "start_acceleration"):
            object.__setattr__(self, name, tuple(np.atleast_1d(numbers(getattr(self, name), name)).ravel().tolist()))

    def limits(self, limits: Limits) -> Limits:
        """Return the scaled limits."""
        return replace(
            limits, velocity=limits.velocity * self.velocity_scale,
            acceleration=limits.acceleration * self.acceleration_scale, jerk=limits.jerk * self.jerk_scale,
        )  # fmt: skip

    def start(self, limits: Limits) -> tuple[Array, Array] | None:
        """Return velocity and acceleration at the start, or None for rest.

        Raises:
            ParameterError: Not one number a joint, or over the limits, given scaled.
        """
        found = []
        for name, limit in (("velocity", limits.velocity), ("acceleration", limits.acceleration)):
            given = np.array(getattr(self, f"start_{name}"), dtype=float)
            if not given.size:
                given = np.zeros(len(limit))
            if given.shape != limit.shape:
                raise ParameterError(f"start_{name}", given.shape, f"{len(limit)} finite numbers, one a joint")
            if np.any(np.abs(given) > limit):
                k = int(np.argmax(np.abs(given) / limit))
                raise ParameterError(f"start_{name}", given[k], f"at most {limit[k]:g} for joint {k + 1}, as scaled")
            found.append(given)
        return (found[0], found[1]) if any(v.any() for v in found) else None


@dataclass(frozen=True, eq=False)
class TimedPath:
    """A path that is timed.

    Attributes:
        trajectory: The motion.
        deviation: Its largest distance from the path [rad].
        way: ``blended``: along a curve that cuts corners, as fast as the limits allow; ``line``: along a straight line
            by Ruckig; ``stops``: by Ruckig from corner to corner; with ``moving start`` before it when it is one.
    """

    trajectory: Trajectory
    deviation: float
    way: str


def time_path(
    path: ArrayLike, limits: Limits, joint_names: Sequence[str], timing: Timing | None = None,
    fault: Callable[[Trajectory], str] = lambda trajectory: "",
) -> TimedPath:  # fmt: skip
    """Time a path.

    A straight line is run along by a jerk-limited profile of Ruckig's (Berscheid and Kroeger 2021), which is the
    fastest. Any other path is made a curve that blends corners; reachability analysis gives the fastest way along it
    within the limits of velocity and acceleration (``compiled.time_parameterization``). States at even times there
    are control points of a uniform cubic B-spline in time: averages of what is within the limits are, and its jerk, the
    change of acceleration from one knot to the next, is bounded by the distance of the knots, which is chosen so that
    the motion is shortest. What is left over a limit is taken away by stretching time. Where ``fault`` finds one, the
    curve stays closer to the path, and at last the motion stops at every corner.

    Args:
        path: States to be joined by straight lines, shape (N, dof).
        limits: Of the joints.
        joint_names: Of the columns.
        timing: How.
        fault: Says what is wrong with a motion, nothing if it is good.

    Raises:
        TimingError: No motion was found, with the fault of the last one that was tried.
        ParameterError: The path has another shape, a number that is none, or a position outside the limits; the names
            are not those of the joints; or an option is out of its range.
    """
    timing = timing or Timing()
    if not isinstance(timing, Timing):
        raise ParameterError("timing", timing, "a Timing")
    states = numbers(path, "path")
    _check(states, limits, joint_names)
    scaled = timing.limits(limits)
    start = timing.start(scaled)
    said, line = "", Polyline.through(states)
    for timed in _ways(line, scaled, tuple(joint_names), timing):
        rest = replace(timed, trajectory=_lasting(timed.trajectory, timing.minimum_duration))
        for one in [rest] if start is None else _moving(start, rest, line, scaled, timing):
            said = fault(one.trajectory)
            if not said:
                return one
    raise TimingError(said or "no motion from the velocity at the start stays within the limits")


def _check(states: Array, limits: Limits, joint_names: Sequence[str]) -> None:
    dof = len(limits.velocity)
    if states.ndim != 2 or states.shape[1] != dof or not len(states):
        raise ParameterError("path", states.shape, f"states of shape (N, {dof})")
    if len(joint_names) != dof:
        raise ParameterError("joint_names", len(joint_names), f"{dof}, as there are joints")
    over = (states < limits.lower - OUTSIDE) | (states > limits.upper + OUTSIDE)
    if over.any():
        k, joint = np.argwhere(over)[0]
        allowed = f"{limits.lower[joint]:g} to {limits.upper[joint]:g} for {joint_names[joint]} in state {k}"
        raise ParameterError("path", float(states[k, joint]), allowed)


def _ways(line: Polyline, limits: Limits, names: tuple[str, ...], timing: Timing) -> Iterator[TimedPath]:
    """Yield motions from rest to rest, each closer to the path than the one before."""
    if line.length <= SAME:
        yield TimedPath(_standing(line.states, names), 0.0, "line")
        return
    corners = line.corners()
    if len(corners.states) > 2:
        for k in range(CLOSER):
            timed = blended(line, limits, names, timing.deviation / 2**k)
            if timed is not None:
                yield timed
    deviation = float(np.linalg.norm(line.states - corners.at(line.arc), axis=1).max())
    yield TimedPath(stops(corners.states, limits, names), deviation, "line" if len(corners.states) == 2 else "stops")


def blended(line: Polyline, limits: Limits, names: tuple[str, ...], within: float) -> TimedPath | None:
    """Return the fastest motion along a curve that stays within a distance of a polyline, or None [rad]."""
    if line.length > MOST_PIECES * SPACING * within:
        return None
    curve = Curve.along(line, SPACING * within)
    first, second = curve.derivatives(PER_PIECE)
    step, window = curve.spacing / PER_PIECE, 2.0 * curve.spacing
    grid = np.linspace(0.0, line.length, len(first))
    if max_distance(curve.points(grid), grid, line.states, line.arc, window) > within:
        return None
    x = np.empty(len(first))
    tried: dict[int, tuple[float, Array, Array]] = {}  # the spacing that the limits let, control points, their places

    def attempt(which: int) -> float:
        """Return the duration with a spacing of knots; what it takes is kept."""
        if which not in tried:
            apart = SPACINGS[which]
            max_path_speeds(
                first, second, limits.velocity, np.minimum(limits.acceleration, limits.jerk * apart), step, x
            )
            took = sample_times(x, step, 0.0, np.empty(0))
            count = max(1, int(took / apart))
            place = np.empty(count + 1)
            sample_times(x, step, took / count, place)
            place[-1] = line.length
            points = curve.points(place)
            points[0], points[-1] = line.states[0], line.states[-1]
            control = np.concatenate([points[:1], points[:1], points, points[-1:], points[-1:]])
            tried[which] = (least_spacing(control, limits), control, place)
        least, knots, _ = tried[which]
        return float(least * (len(knots) - 3))

    best = FIRST
    while best + 1 < len(SPACINGS) and attempt(best + 1) < LITTLE * attempt(best):
        best += 1
    while best > 0 and attempt(best - 1) * LITTLE < attempt(best):
        best -= 1
    while best >= 0:  # knots that are far apart in time smooth the motion too much
        attempt(best)
        apart, control, place = tried[best]
        motion = spline(control, apart, names)
        low, high = line.states.min(axis=0), line.states.max(axis=0)  # where it is, but for rounding
        motion = replace(motion, positions=motion.positions.clip(low, high))
        places = np.concatenate([[0.0], place, [line.length]])
        deviation = _deviation(motion, line, (motion.times, places), window, within)
        if deviation <= within:
            return TimedPath(motion, deviation, "blended")
        best -= 1
    return None


def least_spacing(control: Array, limits: Limits) -> float:
    """Return the least distance of knots at which a cubic B-spline in time keeps the limits [s].

    Velocity is a weighted mean of first differences of the control points; accelerations at knots are the second
    differences, and jerks between them the third.
    """
    needs = []
    difference = control
    for order, limit in enumerate((limits.velocity, limits.acceleration, limits.jerk), 1):
        difference = np.diff(difference, axis=0)
        needs.append(float(np.abs(difference / limit).max(initial=0.0)) ** (1.0 / order))
    return NANOSECOND * float(math.ceil(max(needs) * (1.0 + 1e-9) / NANOSECOND))


def spline(control: Array, apart: float, names: tuple[str, ...]) -> Trajectory:
    """Return the uniform cubic B-spline in time with control points ``apart`` [s]."""
    before, at, after = control[:-2], control[1:-1], control[2:]
    positions = (before + 4.0 * at + after) / 6.0
    positions[0], positions[-1] = control[0], control[-1]
    times = np.arange(len(positions), dtype=float) * apart
    return Trajectory(times, positions, (after - before) / (2.0 * apart), (after - 2.0 * at + before) / apart**2, names)


def _moving(
    start: tuple[Array, Array], timed: TimedPath, line: Polyline, limits: Limits, timing: Timing
) -> list[TimedPath]:
    """Return motions from a moving start, the fastest that stay near the path first, then those that leave it less."""
    found = []
    for motion, head in from_motion(*start, timed.trajectory, limits, timing.minimum_duration):
        nowhere = np.array([0.0, head]), np.zeros(2)
        off = _deviation(motion, line, nowhere, line.length, timing.deviation)
        found.append(TimedPath(motion, max(off, timed.deviation), f"moving start, {timed.way}"))
    return sorted(found, key=lambda one: (max(one.deviation, timing.deviation), one.trajectory.duration))


def _deviation(motion: Trajectory, line: Polyline, places: tuple[Array, Array], window: float, within: float) -> float:
    """Return a bound on the distance of a motion from a polyline.

    It is the largest distance of samples, and how far the motion may be from one of them.

    Args:
        motion: The motion.
        line: The polyline.
        places: Moments up to the last that counts, and how far along the polyline the motion is then.
        window: How far from there the nearest place may be [rad].
        within: The distance that is of interest; samples are a tenth of it apart [rad].
    """
    until = float(places[0][-1])
    speed = float(np.linalg.norm(motion.velocities, axis=1).max()) * FASTER
    count = min(MOST_SAMPLES, max(2, math.ceil(speed * until / (within / 10.0)) + 1))
    times = np.linspace(0.0, until, count)
    points = motion(times)
    if len(line.states) == 1:
        off = float(np.linalg.norm(points - line.states[0], axis=1).max())
    else:
        off = float(max_distance(points, np.interp(times, *places), line.states, line.arc, window))
    between = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)) / 2.0
    return off + between


def _standing(states: Array, names: tuple[str, ...]) -> Trajectory:
    """Return a motion at a state, or to another one that is as good as the same."""
    still = np.zeros_like(states)
    return Trajectory(np.linspace(0.0, INSTANT, len(states)), states.copy(), still, still.copy(), names)


def _lasting(motion: Trajectory, duration: float) -> Trajectory:
    """Return the motion in a time at least so long; one without any stands still so long."""
    if motion.duration >= duration:
        return motion
    if motion.duration > INSTANT:
        return motion.slower(duration / motion.duration)
    still = np.zeros((2, motion.dof))
    return Trajectory(np.array([0.0, duration]), motion.positions[[0, -1]], still, still, motion.joint_names)


@cache
def warm_up() -> None:
    """Load the compiled code, which takes a hundredth of a second in each process, or a few seconds when it is new."""
    x = np.empty(3)
    max_path_speeds(np.ones((3, 1)), np.zeros((3, 1)), np.ones(1), np.ones(1), 1.0, x)
    sample_times(x, 1.0, 1.0, np.empty(1))
    max_distance(np.zeros((1, 1)), np.zeros(1), np.array([[0.0], [1.0]]), np.array([0.0, 1.0]), 1.0)
