"""Time parameterization: from a path to a motion within limits of velocity, acceleration and jerk."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError, TimingError, TimingStoppedError
from apex_ompl.kernel.products import cholesky, solve
from apex_ompl.kernel.timing import arc_lengths, cubic_rates, max_distance, max_path_speeds
from apex_ompl.paths.path import Path
from apex_ompl.robot.model import Limits, Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.timing import ruckig_method, spline_method
from apex_ompl.timing.curve import SAME_STATE, Polyline, deviation_bound
from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.ruckig_method import Profiles, from_moving_start
from apex_ompl.timing.samples import Extremes
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import (
    check_array,
    check_flag,
    check_name,
    check_number,
    check_positive,
    check_states,
    finite_array,
)

METHODS = MappingProxyType({"ruckig": ruckig_method.blended, "spline": spline_method.blended})
"""Methods by name.

Each takes the polyline, the limits, the joint names, the allowed distance from the polyline [rad], a function that
returns True to end the search, and limits of torques and tool speeds or None; it returns the trajectory, a bound on its
distance from the polyline [rad] and the name of what made it, or None.
"""
DEFAULT_METHOD = "ruckig"

SHORTEST_DURATION = 1e-3  # of a motion between states that count as the same [s]
FALLBACK = "spline"  # where the given method has no blended motion
SAME_DURATION = 1.02  # ratio of durations up to which a motion is not timed again for limits of torques and tool speeds
SLOWED_AGAIN = 3  # times that a motion is slowed down to limits, which are sampled anew each time
MOVING_START_SHARES = (1.0, 0.5, 0.25)  # shares of the acceleration limits from a moving start, while a torque is over
FIT_SPACING = 0.01  # of states of a motion whose path is timed anew [s]
BLENDS = 8  # deviations that are tried, each half of the one before, until the motion stops at corners
LIMIT_TOLERANCE = 1e-9  # that a path may be outside the position limits, by rounding [rad]
LIMITS = ("velocity", "acceleration", "jerk")
RANGES = {
    **{f"{limit}_scale": (1e-3, 1.0) for limit in (*LIMITS, "torque")},
    "deviation": (1e-3, 10.0), "minimum_duration": (0.0, spline_method.LONGEST),
}  # fmt: skip


@dataclass(frozen=True)
class Timing:
    """How a path is timed.

    Attributes:
        method: ``ruckig`` or ``spline``, the keys of :data:`METHODS`; straight lines, stops and moving starts
            are by Ruckig with both.
        velocity_scale: Share of the velocity limits that is used, 0.001 to 1.
        acceleration_scale: Share of the acceleration limits.
        jerk_scale: Share of the jerk limits.
        deviation: Largest distance of the motion from the path, 0.001 to 10 [rad, Euclidean; synergies 0..1]; a motion
            from a moving start may leave the path by more where it must.
        minimum_duration: Least duration of the motion, up to 3600 [s].
        max_velocity: Reduced velocity limits by joint name [rad/s], to which the scale is applied too.
        max_acceleration: Reduced acceleration limits by joint name [rad/s^2].
        max_jerk: Reduced jerk limits by joint name [rad/s^3].
        torque_limits: Whether joint torques keep the limits that the robot file gives (``effort``), by inverse
            dynamics with the masses of held objects.
        torque_scale: Share of the torque limits.
        max_torque: Reduced torque limits by joint name, or limits of joints that have none [Nm, N].
        max_tool_speed: Largest speed of every tool, or by name of a hand, held object or link [m/s]; none by default.
            Tools are the hands, at their grasp points, and the held objects, and the last links of a robot without
            hands.
        payload: Mass in each hand, or at each link, by name, beside the held objects [kg]; it goes before the problem's
            own.
        start_velocity: Velocity at the start, one number a joint, or none for rest [rad/s].
        start_acceleration: Acceleration at the start, one number a joint, or none for zero [rad/s^2].
    """

    method: str = DEFAULT_METHOD
    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    jerk_scale: float = 1.0
    deviation: float = 0.05
    minimum_duration: float = 0.0
    max_velocity: Mapping[str, float] = field(default_factory=dict)
    max_acceleration: Mapping[str, float] = field(default_factory=dict)
    max_jerk: Mapping[str, float] = field(default_factory=dict)
    torque_limits: bool = True
    torque_scale: float = 1.0
    max_torque: Mapping[str, float] = field(default_factory=dict)
    max_tool_speed: float | Mapping[str, float] | None = None
    payload: Mapping[str, float] = field(default_factory=dict)
    start_velocity: Sequence[float] = ()
    start_acceleration: Sequence[float] = ()

    __repr__ = fields_line

    def __post_init__(self) -> None:
        """Check the name and the numbers.

        Raises:
            UnknownNameError: No such method.
            ParameterError: A number is out of its range.
        """
        check_name(self.method, "timing method", METHODS)
        for name, (low, high) in RANGES.items():
            check_number(getattr(self, name), name, low, high)
        check_flag(self.torque_limits, "torque_limits")
        for name in (*(f"max_{limit}" for limit in (*LIMITS, "torque")), "payload"):
            for key, value in _by_name(self, name).items():
                check_positive(value, f"{name}.{key}")
        if self.max_tool_speed is not None and not isinstance(self.max_tool_speed, Mapping):
            check_positive(self.max_tool_speed, "max_tool_speed", "a positive number, or numbers by name")
        else:
            for tool, value in (self.max_tool_speed or {}).items():
                check_positive(value, f"max_tool_speed.{tool}")
        for name in ("start_velocity", "start_acceleration"):
            object.__setattr__(
                self, name, tuple(np.atleast_1d(finite_array(getattr(self, name), name)).ravel().tolist())
            )

    def limits(self, limits: Limits, joint_names: Sequence[str]) -> Limits:
        """Return the limits of a plan: the lower ones of single joints, scaled.

        Args:
            limits: The robot's limits, which are upper bounds.
            joint_names: Names of the joints in their order.

        Raises:
            UnknownNameError: A limit is for an unknown joint.
            ParameterError: A limit is higher than the robot's, or one of the robot's is not positive.
        """
        if len(joint_names) != len(limits.velocity):
            raise ParameterError("joint_names", len(joint_names), f"{len(limits.velocity)}, as there are joints")
        for limit in LIMITS:
            for joint, value in zip(joint_names, getattr(limits, limit).tolist(), strict=True):
                check_positive(value, f"{limit} limit of {joint}")
        scaled = {}
        for limit in LIMITS:
            values = np.array(getattr(limits, limit))
            for joint, value in _by_name(self, f"max_{limit}").items():
                check_name(joint, "joint", joint_names)
                k = list(joint_names).index(joint)
                if value > values[k]:
                    raise ParameterError(f"max_{limit}.{joint}", value, f"at most {values[k]:g}, the robot's limit")
                values[k] = value
            scaled[limit] = values * getattr(self, f"{limit}_scale")
        return replace(limits, **scaled)

    def motion_limits(
        self, robot: Robot, held: Sequence[AttachedObject] = (), payload: Mapping[str, float] | None = None
    ) -> MotionLimits | None:
        """Return the limits of torques and tool speeds, or None where there are none.

        Args:
            robot: The robot.
            held: Held objects; those without a mass count as weightless.
            payload: Mass in each hand or at each link by name, beside them [kg], such as that of a problem.

        Raises:
            UnknownNameError: There is no such joint, hand, held object or link.
            ParameterError: A limit is higher than the robot's.
            RobotError: Torques are limited, and no link of the robot has a mass.
        """
        torque = robot.effort.copy() if self.torque_limits else np.full(robot.dof, np.inf)
        for joint, value in _by_name(self, "max_torque").items():
            check_name(joint, "joint", robot.joint_names)
            k = robot.joint_names.index(joint)
            if value > torque[k]:
                raise ParameterError(f"max_torque.{joint}", value, f"at most {torque[k]:g}, the robot's limit")
            torque[k] = value
        torque *= self.torque_scale
        if not np.isfinite(torque).any() and not self.max_tool_speed:
            return None
        return MotionLimits(robot, torque, self.max_tool_speed, held, {**(payload or {}), **self.payload})

    def start(self, limits: Limits) -> tuple[Array, Array] | None:
        """Return velocity and acceleration at the start, each of shape (dof,), or None for rest.

        Args:
            limits: The scaled limits.

        Raises:
            ParameterError: Not one number a joint, or a number over its limit.
        """
        derivatives = []
        for name, limit in (("velocity", limits.velocity), ("acceleration", limits.acceleration)):
            given = np.array(getattr(self, f"start_{name}"), dtype=float)
            if not given.size:
                given = np.zeros(len(limit))
            check_array(given, limit.shape, f"start_{name}")
            if np.any(np.abs(given) > limit):
                k = int(np.argmax(np.abs(given) / limit))
                raise ParameterError(f"start_{name}", given[k], f"at most {limit[k]:g} for joint {k + 1}, as scaled")
            derivatives.append(given)
        return (derivatives[0], derivatives[1]) if any(v.any() for v in derivatives) else None


@dataclass(frozen=True, eq=False)
class TimedPath:
    """A timed path.

    Attributes:
        trajectory: The motion.
        deviation: Its largest distance from the path [rad].
        method: Name of the method that made it.
        form: ``blended``: along a curve that cuts corners, as fast as the limits allow; ``line``: along a straight
            line; ``stops``: from corner to corner; with ``moving start`` before it where the motion does not start at
            rest.
    """

    trajectory: Trajectory
    deviation: float
    method: str
    form: str

    __repr__ = fields_line


def time_path(
    path: Path | ArrayLike, limits: Limits, joint_names: Sequence[str], timing: Timing | None = None,
    fault: Callable[[Trajectory], str] = lambda trajectory: "", *, stop: Callable[[], bool] = lambda: False,
    motion_limits: MotionLimits | None = None,
) -> TimedPath:  # fmt: skip
    """Time a path.

    A straight line is followed by a jerk-limited profile of Ruckig's (:mod:`apex_ompl.timing.ruckig_method`),
    which is the fastest. Any other path is followed by a blended motion of the method in ``timing``. Where ``fault``
    rejects a motion, half its deviation is tried, several times, and last a motion that stops at every corner. Where
    Ruckig has no motion within the deviation and the position limits, which it does not take into account, the spline
    method is used.

    A motion that exceeds ``motion_limits`` is slowed down as a whole, or timed again with these limits in the
    reachability analysis, by either method, whichever is faster.

    Args:
        path: Path, or states of shape (N, dof). The motion follows the straight lines between its states, also where
            it has a spline, because these are what passed the full check.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        timing: How the path is timed.
        fault: Returns the reason for which a motion is invalid, or an empty text.
        stop: Called often; True ends the search.
        motion_limits: Limits of torques and tool speeds, see :meth:`Timing.motion_limits`; those that ``timing`` gives
            need the robot, and count only if they are given here.

    Raises:
        TimingStoppedError: ``stop`` returned True before there was a valid motion.
        TimingError: No valid motion was found; the message is the fault of the last one that was tried.
        ParameterError: The path has another shape, a number that is not finite, or a position outside the limits; the
            names are not those of the joints; or an option is out of its range.
    """
    timing = timing or Timing()
    if not isinstance(timing, Timing):
        raise ParameterError("timing", timing, "a Timing")
    if not isinstance(limits, Limits):
        raise ParameterError("limits", limits, "a Limits, such as load_robot(...).limits")
    states = finite_array(path.states if isinstance(path, Path) else path, "path")
    scaled = timing.limits(limits, joint_names)
    _check(states, limits, joint_names)
    start = timing.start(scaled)
    line, reason = Polyline.through(states), "" if motion_limits is None else motion_limits.gravity_fault(states)
    if reason:
        raise TimingError(reason)
    for timed in _from_rest(line, scaled, tuple(joint_names), timing, stop=stop, more=motion_limits):
        rest = replace(timed, trajectory=_lasting(timed.trajectory, timing.minimum_duration).merged())
        for candidate in (
            [rest]
            if start is None
            else _from_moving_start(start, rest, line, scaled, timing, stop=stop, more=motion_limits)
        ):
            reason = fault(candidate.trajectory)
            if not reason:
                return candidate
            if stop():
                break
    if stop():
        raise TimingStoppedError(reason or "no motion was found in time")
    raise TimingError(reason or "no motion from the velocity at the start stays within the limits")


def fitted(
    motion: Trajectory, limits: Limits, more: MotionLimits, timing: Timing | None = None,
    *, stop: Callable[[], bool] = lambda: False,
) -> TimedPath:  # fmt: skip
    """Return a motion from rest to rest along the path of another one that keeps limits of torques and tool speeds.

    It is the motion itself where it keeps them, else the faster of the motion slowed down as a whole and of a motion
    timed along its path, by the method of ``timing``, with these limits in the reachability analysis. The second
    deviates from the path, so that it must be checked for collisions anew.

    Args:
        motion: Motion from rest to rest within the limits of its joints.
        limits: The scaled limits of the joints.
        more: Limits of torques and tool speeds.
        timing: Method and allowed deviation.
        stop: Called often; where it returns True, the slowed motion is returned.

    Raises:
        TimingError: Gravity alone exceeds a limit.
    """
    timing = timing or Timing()
    slowed, factor = _slowed(TimedPath(motion, 0.0, timing.method, "slowed"), more)
    if factor <= SAME_DURATION:
        return slowed
    line = Polyline.through(motion(np.linspace(0.0, motion.duration, math.ceil(motion.duration / FIT_SPACING) + 1)))
    blended = _blended(
        line, limits, motion.joint_names, timing.method, timing.deviation, stop=stop, more=more, plain=False
    )
    return slowed if blended is None or blended.trajectory.duration >= slowed.trajectory.duration else blended


def _by_name(timing: Timing, field: str) -> Mapping[str, float]:
    given = getattr(timing, field)
    if not isinstance(given, Mapping):
        raise ParameterError(field, given, "masses by hand or link" if field == "payload" else "values by joint name")
    return given


def _check(states: Array, limits: Limits, joint_names: Sequence[str]) -> None:
    dof = len(limits.velocity)
    check_states(states, dof, "path", least=1)
    over = (states < limits.lower - LIMIT_TOLERANCE) | (states > limits.upper + LIMIT_TOLERANCE)
    if over.any():
        k, joint = np.argwhere(over)[0]
        allowed = f"{limits.lower[joint]:g} to {limits.upper[joint]:g} for {joint_names[joint]} in state {k}"
        raise ParameterError("path", float(states[k, joint]), allowed)


def _from_rest(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], timing: Timing,
    *, stop: Callable[[], bool], more: MotionLimits | None,
) -> Iterator[TimedPath]:  # fmt: skip
    """Yield motions from rest to rest, each closer to the path than the one before, until ``stop`` holds."""
    if stop():
        return
    if line.length <= SAME_STATE:
        yield TimedPath(_at_rest(line.states, joint_names), 0.0, "ruckig", "line")
        return
    straight = len(line.corners().states) == 2
    for k in range(0 if straight else BLENDS):
        blended = _blended(line, limits, joint_names, timing.method, timing.deviation / 2**k, stop=stop, more=more)
        if stop():
            return
        if blended is not None:
            yield blended
    motion = ruckig_method.stops(line, limits, joint_names, stop)
    if motion is None:
        return
    stopping, factor = _slowed(TimedPath(*motion, "line" if straight else "stops"), more)
    if straight and factor > SAME_DURATION:
        blended = _blended(line, limits, joint_names, "spline", timing.deviation, stop=stop, more=more)
        if blended is not None and blended.trajectory.duration < stopping.trajectory.duration:
            yield replace(blended, form="line")
    yield stopping


def _blended(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], method: str, deviation: float,
    *, stop: Callable[[], bool], more: MotionLimits | None, plain: bool = True,
) -> TimedPath | None:  # fmt: skip
    """Return the blended motion of a method, or of ``FALLBACK`` where it has none; the fastest that keeps ``more``.

    A motion that need not be slowed down is returned at once. With ``plain`` one that is made without ``more`` is tried
    first.
    """
    fastest: TimedPath | None = None
    for way in dict.fromkeys((method, FALLBACK)):
        for rows in dict.fromkeys((None, more) if plain else (more,)):
            motion = METHODS[way](line, limits, joint_names, deviation, stop, more=rows)
            if motion is None:
                break
            timed, factor = _slowed(TimedPath(*motion, "blended"), more)
            if fastest is None or timed.trajectory.duration * SAME_DURATION < fastest.trajectory.duration:
                fastest = timed
            if factor <= SAME_DURATION:
                return fastest
    return fastest


def _slowed(timed: TimedPath, more: MotionLimits | None) -> tuple[TimedPath, float]:
    """Return a motion slowed down to the limits of torques and tool speeds, and the factor.

    Raises:
        TimingError: Gravity alone exceeds a limit.
    """
    if more is None:
        return timed, 1.0
    motion = timed.trajectory
    for _ in range(SLOWED_AGAIN):
        factor = more.stretch(motion)
        if not np.isfinite(factor):
            raise TimingError("gravity alone exceeds a limit of torque along the motion")
        if factor == 1.0:
            break
        motion = motion.slower(factor)
    return replace(timed, trajectory=motion), motion.duration / timed.trajectory.duration


def _from_moving_start(
    start: tuple[Array, Array], timed: TimedPath, line: Polyline, limits: Limits, timing: Timing,
    *, stop: Callable[[], bool], more: MotionLimits | None,
) -> list[TimedPath]:  # fmt: skip
    """Return motions from a moving start: those within the deviation, fastest first, then the others, nearest first.

    Args:
        start: Velocity and acceleration at the start, each of shape (dof,).
        timed: The motion from rest, which they join.
        line: The path.
        limits: The scaled limits.
        timing: How the path is timed.
        stop: Called often; True ends the search.
        more: Limits of torques and tool speeds.

    Raises:
        TimingError: All of them exceed a limit of torque or tool speed.
    """
    candidates, reason = [], ""
    for share in MOVING_START_SHARES if more is not None else (1.0,):
        within = replace(limits, acceleration=share * limits.acceleration)
        for motion, join_time in from_moving_start(*start, timed.trajectory, within, timing.minimum_duration):
            if stop():
                break
            reason = "" if more is None else more.fault(motion)
            if reason:
                continue
            arc_at = np.array([0.0, join_time]), np.zeros(2)  # it may be near any point of the path
            head_deviation = deviation_bound(motion, line, arc_at, line.length, timing.deviation, stop=stop)
            deviation, form = max(head_deviation, timed.deviation), f"moving start, {timed.form}"
            candidates.append(replace(timed, trajectory=motion, deviation=deviation, form=form))
        if candidates or not reason:
            break
    if reason and not candidates and not stop():
        raise TimingError(reason)
    return sorted(candidates, key=lambda made: (max(made.deviation, timing.deviation), made.trajectory.duration))


def _at_rest(states: Array, joint_names: tuple[str, ...]) -> Trajectory:
    """Return a motion at rest at a state, shape (1, dof), or to another one that counts as the same, shape (2, dof)."""
    still = np.zeros_like(states)
    return Trajectory(np.linspace(0.0, SHORTEST_DURATION, len(states)), states.copy(), still, still.copy(), joint_names)


def _lasting(motion: Trajectory, duration: float) -> Trajectory:
    """Return a motion slowed down to a duration [s] if it is shorter; a motion at rest is prolonged."""
    if motion.duration >= duration:
        return motion
    if motion.duration > SHORTEST_DURATION:
        return motion.slower(duration / motion.duration)
    still = np.zeros((2, motion.dof))
    return Trajectory(np.array([0.0, duration]), motion.positions[[0, -1]], still, still, motion.joint_names)


@cache
def warm_up() -> None:
    """Load the compiled code: about 10 ms in each process, or a few seconds when it must be compiled first."""
    arc_lengths(max_path_speeds(np.ones((3, 1)), np.zeros((3, 1)), np.ones(1), np.ones(1), 1.0), 1.0, 1.0, 1)
    max_distance(np.zeros((1, 1)), np.zeros(1), np.array([[0.0], [1.0]]), np.array([0.0, 1.0]), 1.0)
    still = Profiles(np.ones((1, 1, 1)), np.zeros((1, 1, 1)), np.ones(1), brakes=False)
    motion = still.joined(np.zeros((3, 2, 1)), ("joint",))
    Trajectory(*motion.knots, ("joint",)).states(motion.times)
    Extremes.of(*motion.knots)
    cubic_rates(motion.knots)
    solve(cholesky(np.eye(1)), np.ones((1, 1)))  # for spline fits
