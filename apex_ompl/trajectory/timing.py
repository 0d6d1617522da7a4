"""Time parameterisation: from a path to a motion within limits of velocity, acceleration and jerk."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.speed import farthest, fastest, moments
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.curve import Curve, Polyline
from apex_ompl.trajectory.motion import Trajectory
from apex_ompl.trajectory.points import from_motion, stops

Array = NDArray[np.float64]

PER_PIECE = 10  # points of the grid a piece of the curve
SPACINGS = (0.004, 0.006, 0.008, 0.012, 0.016, 0.024, 0.032, 0.048, 0.064, 0.096, 0.128, 0.192, 0.256, 0.512)
FINE = 0.008  # distance of moments at which the deviation is measured, at most [s]
SPACING = 3.0  # of control points, as a multiple of the deviation; a corner is cut by a third
FIRST = 4  # of the spacings of knots, that is tried first [s]
CLOSER = 6  # times that the blending of corners is halved before the motion stops at them
HEAD = 64  # moments of what comes before the path at a moving start, at which the deviation is measured
NANOSECOND = 1e-9


@dataclass(frozen=True)
class Timing:
    """How a path is timed.

    Attributes:
        velocity_scale: Share of the limits of velocity that is used, over 0 to 1.
        acceleration_scale: The same of acceleration.
        jerk_scale: The same of jerk.
        deviation: Largest distance of the motion from the path, over 0 [rad, Euclidean; synergies 0..1]; a motion from
            a moving start may leave it by more, as little as can be.
        minimum_duration: The motion takes at least so long [s].
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
        for name in ("velocity_scale", "acceleration_scale", "jerk_scale"):
            if not _is_number(getattr(self, name)) or not 0.0 < getattr(self, name) <= 1.0:
                raise ParameterError(name, getattr(self, name), "a number over 0, at most 1")
        if not _is_number(self.deviation) or not 0.0 < self.deviation < math.inf:
            raise ParameterError("deviation", self.deviation, "a positive number of radians")
        if not _is_number(self.minimum_duration) or not 0.0 <= self.minimum_duration < math.inf:
            raise ParameterError("minimum_duration", self.minimum_duration, "a number of seconds, 0 or more")

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
            if given.shape != limit.shape or not np.isfinite(given).all():
                raise ParameterError(f"start_{name}", given.shape, f"{len(limit)} finite numbers, one a joint")
            if np.any(np.abs(given) > limit):
                k = int(np.argmax(np.abs(given) / limit))
                raise ParameterError(f"start_{name}", given[k], f"at most {limit[k]:g} for joint {k + 1}, as scaled")
            found.append(given)
        return (found[0], found[1]) if any(v.any() for v in found) else None


@dataclass(frozen=True, eq=False)
class Timed:
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
) -> Timed | str:  # fmt: skip
    """Time a path, or say why it cannot be.

    A straight line is run along by a jerk-limited profile of Ruckig's (Berscheid and Kroeger 2021), which is the
    fastest. Any other path is made a curve that blends corners; reachability analysis gives the fastest way along it
    within the limits of velocity and acceleration (:mod:`apex_ompl.kernel.speed`). The states on this way at even times
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

    Returns:
        The timed path, or the fault of the last motion that was tried.

    Raises:
        ParameterError: The path has another shape or a number that is none, or an option is out of its range.
    """
    timing = timing or Timing()
    states = np.array(path, dtype=float)
    if states.ndim != 2 or states.shape[1] != len(limits.velocity) or not len(states) or not np.isfinite(states).all():
        raise ParameterError("path", states.shape, f"finite numbers of shape (N, {len(limits.velocity)})")
    scaled = timing.limits(limits)
    start = timing.start(scaled)
    said, line = "", Polyline.through(states)
    for timed in _ways(line, scaled, tuple(joint_names), timing):
        rest = replace(timed, trajectory=_lasting(timed.trajectory, timing.minimum_duration))
        for one in [rest] if start is None else _moving(start, rest, line, scaled, timing):
            said = fault(one.trajectory)
            if not said:
                return one
    return said or "no motion from the velocity at the start stays within the limits"


def _ways(line: Polyline, limits: Limits, names: tuple[str, ...], timing: Timing) -> Iterator[Timed]:
    """Yield motions from rest to rest, each closer to the path than the one before."""
    if len(line.states) == 1:
        yield Timed(_standing(line.states[0], names), 0.0, "line")
        return
    corners = line.corners()
    if len(corners.states) > 2:
        for k in range(CLOSER):
            timed = blended(line, limits, names, timing.deviation / 2**k)
            if timed is not None:
                yield timed
    deviation = float(np.linalg.norm(line.states - corners.at(line.arc), axis=1).max())
    yield Timed(stops(corners.states, limits, names), deviation, "line" if len(corners.states) == 2 else "stops")


def blended(line: Polyline, limits: Limits, names: tuple[str, ...], within: float) -> Timed | None:
    """Return the fastest motion along a curve that stays within a distance of a polyline, or None [rad]."""
    curve = Curve.along(line, SPACING * within)
    first, second = curve.derivatives(PER_PIECE)
    step, window = curve.spacing / PER_PIECE, 2.0 * curve.spacing
    grid = np.linspace(0.0, line.length, len(first))
    if farthest(curve.points(grid), grid, line.states, line.arc, window) > within:
        return None
    x = np.empty(len(first))
    tried: dict[int, tuple[float, Array, Array]] = {}  # the spacing that the limits let, control points, their places

    def attempt(which: int) -> float:
        """Return the duration with a spacing of knots; what it takes is kept."""
        if which not in tried:
            apart = SPACINGS[which]
            fastest(first, second, limits.velocity, np.minimum(limits.acceleration, limits.jerk * apart), step, x)
            took = moments(x, step, 0.0, np.empty(0))
            count = max(1, int(took / apart))
            place = np.empty(count + 1)
            moments(x, step, took / count, place)
            place[-1] = line.length
            points = curve.points(place)
            points[0], points[-1] = line.states[0], line.states[-1]
            control = np.concatenate([points[:1], points[:1], points, points[-1:], points[-1:]])
            tried[which] = (_least_spacing(control, limits), control, place)
        least, knots, _ = tried[which]
        return float(least * (len(knots) - 3))

    best = FIRST
    for direction in (1, -1):
        while 0 <= best + direction < len(SPACINGS) and attempt(best + direction) < attempt(best):
            best += direction
    while best >= 0:  # knots that are far apart in time smooth the motion too much
        attempt(best)
        apart, control, place = tried[best]
        motion = _spline(control, apart, names)
        times = np.linspace(0.0, motion.duration, (len(motion.times) - 1) * math.ceil(apart / FINE) + 1)
        at = np.interp(times, motion.times, np.concatenate([[0.0], place, [line.length]]))
        deviation = float(farthest(motion(times), at, line.states, line.arc, window))
        if deviation <= within:
            return Timed(motion, deviation, "blended")
        best -= 1
    return None


def _least_spacing(control: Array, limits: Limits) -> float:
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


def _spline(control: Array, apart: float, names: tuple[str, ...]) -> Trajectory:
    """Return the uniform cubic B-spline in time with control points ``apart`` [s]."""
    before, at, after = control[:-2], control[1:-1], control[2:]
    positions = (before + 4.0 * at + after) / 6.0
    positions[0], positions[-1] = control[0], control[-1]
    times = np.arange(len(positions), dtype=float) * apart
    return Trajectory(times, positions, (after - before) / (2.0 * apart), (after - 2.0 * at + before) / apart**2, names)


def _moving(start: tuple[Array, Array], timed: Timed, line: Polyline, limits: Limits, timing: Timing) -> list[Timed]:
    """Return motions from a moving start, the fastest that stay near the path first, then those that leave it less."""
    found = []
    for motion, head in from_motion(*start, timed.trajectory, limits, timing.minimum_duration):
        points = motion(np.linspace(0.0, head, HEAD))
        off = float(farthest(points, np.zeros(HEAD), line.states, line.arc, line.length))
        found.append(Timed(motion, max(off, timed.deviation), f"moving start, {timed.way}"))
    return sorted(found, key=lambda one: (max(one.deviation, timing.deviation), one.trajectory.duration))


def _standing(state: Array, names: tuple[str, ...]) -> Trajectory:
    still = np.zeros((1, len(state)))
    return Trajectory(np.zeros(1), state[None].copy(), still, still.copy(), names)


def _lasting(motion: Trajectory, duration: float) -> Trajectory:
    """Return the motion in a time at least so long; one without any stands still so long."""
    if motion.duration >= duration:
        return motion
    if motion.duration:
        return motion.slower(duration / motion.duration)
    twice = [np.repeat(part, 2, axis=0) for part in (motion.positions, motion.velocities, motion.accelerations)]
    return Trajectory(np.array([0.0, duration]), twice[0], twice[1], twice[2], motion.joint_names)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


@cache
def warm_up() -> None:
    """Load the compiled code, which takes a hundredth of a second in each process, or a few seconds when it is new."""
    x = np.empty(3)
    fastest(np.ones((3, 1)), np.zeros((3, 1)), np.ones(1), np.ones(1), 1.0, x)
    moments(x, 1.0, 1.0, np.empty(1))
    farthest(np.zeros((1, 1)), np.zeros(1), np.array([[0.0], [1.0]]), np.array([0.0, 1.0]), 1.0)
