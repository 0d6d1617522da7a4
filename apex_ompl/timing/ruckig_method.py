"""Motions by Ruckig (Berscheid and Kroeger 2021): blended ones, stops at corners, and motions from a moving start."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
import ruckig

from apex_ompl.errors import TimingError
from apex_ompl.kernel.timing import TICK, join_profiles
from apex_ompl.robot.model import Limits
from apex_ompl.timing.curve import Polyline, deviation_bound
from apex_ompl.timing.knots import LEAST_SPANS, refitted, removable
from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.samples import Extremes
from apex_ompl.timing.spline_method import blend
from apex_ompl.timing.trajectory import LEAST_SPACING, ROUNDING, Trajectory, joined
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct

SHORTEST_PIECE = 1e-9  # [s]
LIMITS_SHARE = 1.0 - 1e-6  # share of the limits that Ruckig is given, for its rounding
JERK_SHARE = 1.0 - 1e-5  # share of the jerk limit, which leaves room for rounding
LIMITS_MARGIN = 1.0 + 1e-10  # factor on the limits where the given states are at them
STILL = 1e-12  # range of a joint that stays [rad]
DERIVATIVES = ("velocity", "acceleration", "jerk")
JOIN_TIMES = 12  # intervals of a motion at whose ends a moving start may join it
SAME_PROBLEM = 0.01  # share of an acceleration limit by which neighboring spans of one problem may differ from a line
JERK_MARGIN = 1e-4  # share by which the jerk limit of a problem is over the jerk of the given motion
JERK_FLOORS = (1e-5, 1e-4)  # added to it, times the cubed duration of the problem: tried in turn [rad]
FLOOR_SHARE = 0.01  # largest floor, as a share of the limit
WINDOW = 0.2  # in which a motion with fewer knots meets the given one [s]
NUDGED, NUDGE = 1e-8, 1e-9  # Ruckig 0.19 crashes on a joint that returns at the opposite velocity [rad, rad/s]
WIDE = 2.0  # factor on the largest velocity and acceleration of a motion, for the limits of its problems
SAME_DURATION = 1e-6  # relative difference of durations that count as one
CALM_TIME = 1.005  # duration of a straight motion over the shortest one, for which its jerk is the least
JERK_STEPS = 20  # of the bisection for the least jerk
LEAST_JERK = 1e-3  # share of the limit, or of the largest jerk of a line, below which it is not lowered
HEAD_SHARES = (1.0, 0.995, 0.98, 0.95)  # of the limits, for motions from a moving start, whose knots are merged
HEAD_SPACINGS = (8e-3, LEAST_SPACING)  # of their knots, tried in turn [s]
CALMER = (0.5, 0.25, 0.125, 0.0625)  # shares of the jerk limits that are tried for them


def calculate(solver: ruckig.Ruckig, query: ruckig.InputParameter, solution: ruckig.Trajectory) -> None:
    """Solve a query of Ruckig's and put the motion into ``solution``.

    Raises:
        RuckigError: It has no solution.
    """
    try:
        result = solver.calculate(query, solution)
    except ValueError as error:  # a result that the bindings have no name for
        raise ruckig.RuckigError(str(error)) from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise ruckig.RuckigError(str(result))


def knots(solution: ruckig.Trajectory) -> tuple[Array, Array, Array, Array]:
    """Return the times at which the jerk of any joint changes, both ends included, and the states at them.

    Returns:
        Times of shape (K,) [s]; positions, velocities and accelerations of shape (K, dof).
    """
    changes = [0.0, solution.duration]
    for profile in solution.profiles[0]:
        changes += [*np.cumsum(profile.brake.t), *(profile.brake.duration + np.cumsum(profile.t))]
    times = distinct(np.clip(changes, 0.0, solution.duration))
    times = times[np.append(True, np.diff(times) > SHORTEST_PIECE)]
    if len(times) > 1:
        times[-1] = solution.duration
    states = (solution.at_time(float(time)) for time in times)
    q, v, a = (np.array(values) for values in zip(*states, strict=True))
    return times, q, v, a


class Profiles(NamedTuple):
    """Motions of joints from state to state in phases of constant jerk.

    Attributes:
        phases: Durations of the phases of each motion and joint, shape (K, dof, phases) [s].
        jerks: Jerks in the phases, shape (K, dof, phases) [rad/s^3].
        durations: Durations of the motions, shape (K,) [s].
        brakes: Whether any motion starts by braking, as Ruckig does from a state over a limit.
    """

    phases: Array
    jerks: Array
    durations: Array
    brakes: bool

    @classmethod
    def of(cls, solutions: Sequence[ruckig.Trajectory]) -> Self:
        """Return those of Ruckig's solutions."""
        rows = [solution.profiles[0] for solution in solutions]
        phases = np.array([[profile.t for profile in row] for row in rows])
        jerks = np.array([[profile.j for profile in row] for row in rows])
        durations = np.array([solution.duration for solution in solutions])
        brakes = bool(np.abs(phases.sum(axis=2) - durations[:, None]).max() > TICK)
        if brakes:
            before = [[profile.brake for profile in row] for row in rows]
            phases = np.concatenate([np.array([[brake.t for brake in row] for row in before]), phases], axis=2)
            jerks = np.concatenate([np.array([[brake.j for brake in row] for row in before]), jerks], axis=2)
        return cls(phases, jerks, durations, brakes)

    def joined(self, states: Array, joint_names: tuple[str, ...]) -> Trajectory:
        """Return consecutive motions as one trajectory that goes through given states exactly.

        Its knots are where the jerk of any joint changes.

        Args:
            states: Positions, velocities and accelerations at their ends, shape (3, K + 1, dof).
            joint_names: Names of the joints.
        """
        starts = np.round(np.cumsum([0.0, *self.durations]) / TICK).astype(np.int64)
        return Trajectory.unchecked(*join_profiles(self.phases, self.jerks, starts, states), joint_names)


def blended(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], deviation: float,
    stop: Callable[[], bool] = lambda: False, *, more: MotionLimits | None = None,
) -> tuple[Trajectory, float, str] | None:  # fmt: skip
    """Return Ruckig's motion along a polyline, its corners rounded.

    It follows the fastest spline in time (:func:`apex_ompl.timing.spline_method.blend`) by :func:`calm`, where
    neighboring spans become one state-to-state problem if the motion then keeps ``deviation``.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        deviation: Largest distance of the motion from the polyline [rad].
        stop: Called before every state-to-state problem; True ends the search.
        more: Limits of torques and tool speeds, see :func:`apex_ompl.timing.spline_method.blend`.

    Returns:
        The motion, a bound on its distance from the polyline [rad], and the name of the method
        (:attr:`Calm.method`); or None where none keeps ``deviation``, or when ``stop`` returned True.
    """
    guide = blend(line, limits, joint_names, deviation, stop, more=more)
    if guide is None:
        return None
    for tolerance in (SAME_PROBLEM, 0.0):
        made = calm(guide.trajectory, limits, stop, tolerance)
        if made is None:
            return None
        bound = guide.deviation
        if made.problems < len(guide.trajectory.times) - 1:
            bound = deviation_bound(made.trajectory, line, guide.arc_at, guide.window, deviation, stop=stop)
        if bound <= deviation:
            return made.trajectory, bound, made.method
    return None


class Calm(NamedTuple):
    """A motion by Ruckig at the least jerks.

    Attributes:
        trajectory: The motion.
        problems: Number of its state-to-state problems.
        solved: How many of them Ruckig solved; in the others the motion is the given one.
    """

    trajectory: Trajectory
    problems: int
    solved: int

    @property
    def method(self) -> str:
        """Name of the method: ``ruckig``, with the number of problems where it did not solve all of them."""
        return "ruckig" if self.solved == self.problems else f"ruckig in {self.solved} of {self.problems} spans"


def calm(
    motion: Trajectory, limits: Limits, stop: Callable[[], bool] = lambda: False, tolerance: float = SAME_PROBLEM
) -> Calm | None:
    """Return Ruckig's motion that follows a spline in time at the least jerk of each joint.

    1. Neighboring spans in which the accelerations of all joints are nearly on a line become one state-to-state
       problem, where the motion with fewer knots keeps the limits.
    2. In each problem, of duration h, the jerk limit of each joint is a little over its jerk J on the way: |J| + d.
       Ruckig's motion between the states at both ends has this duration and keeps that limit. So its accelerations are
       within d h and its positions within d h^3 / 4 of those with the constant jerk J, some microradians.
    3. But for one, its phases last microseconds. They are merged into that one, so that the knots are the ends of the
       problems.

    Where Ruckig finds no motion of the duration h, the given motion is kept.

    Args:
        motion: Motion of constant jerk between knots, within the limits.
        limits: Limits of the joints.
        stop: Called before every state-to-state problem; True ends the search.
        tolerance: Distance from the line, as a share of the acceleration limits; with 0 every span is a problem.

    Returns:
        The motion, which takes as long as the given one and has the same ends; or None when ``stop`` returned True.
    """
    motion = _fewer_problems(motion.merged(), limits, tolerance) if tolerance else motion.merged()
    if len(motion.times) == 1:
        return Calm(motion, 0, 0)
    solver, query = ruckig.Ruckig(motion.dof), ruckig.InputParameter(motion.dof)
    solution = ruckig.Trajectory(motion.dof)
    lengths = np.diff(motion.times)
    states = np.stack([motion.positions, motion.velocities, motion.accelerations])
    still = np.ptp(motion.positions, axis=0) <= STILL  # up to rounding, which Ruckig would follow
    states[0][:, still], states[1:, :, still] = motion.positions[0, still], 0.0
    cubed = lengths[:, None] ** 3
    floors = [np.minimum(floor / cubed, FLOOR_SHARE * limits.jerk) for floor in JERK_FLOORS]
    jerks = [((1.0 + JERK_MARGIN) * np.abs(motion.jerks) + floor).tolist() for floor in floors]
    largest = np.abs(states[2]).max(axis=0)
    query.max_acceleration = (WIDE * largest + limits.acceleration).tolist()
    reach = largest**2 / np.min([floor.min(axis=0) for floor in floors], axis=0)  # reached at such a jerk
    query.max_velocity = (WIDE * np.abs(states[1]).max(axis=0) + limits.velocity + reach).tolist()
    rows, solved = states.tolist(), 0
    returns = (np.abs(np.diff(states[0], axis=0)) < NUDGED) & (np.abs(states[1, 1:] + states[1, :-1]) < NUDGED)
    targets = (states[1, 1:] + np.where(returns & (states[1, :-1] != 0.0), NUDGE, 0.0)).tolist()
    for k, length in enumerate(lengths.tolist()):
        if stop():
            return None
        query.current_position, query.current_velocity, query.current_acceleration = (values[k] for values in rows)
        query.target_position, _, query.target_acceleration = (values[k + 1] for values in rows)
        query.target_velocity = targets[k]
        query.minimum_duration = length
        for limit in jerks:
            query.max_jerk = limit[k]
            try:
                calculate(solver, query, solution)
            except ruckig.RuckigError:
                continue
            if abs(solution.duration - length) <= SAME_DURATION * length:
                solved += 1
                break
    return Calm(motion, len(lengths), solved)


def _fewer_problems(motion: Trajectory, limits: Limits, tolerance: float) -> Trajectory:
    """Return a motion without the knots that are in the middle of one problem, where it keeps the limits."""
    removed = removable(motion.accelerations, motion.times, tolerance * limits.acceleration)
    if not removed.any() or len(motion.times) - removed.sum() <= LEAST_SPANS:
        return motion
    times = motion.times[~removed]
    states = refitted(motion.states(times), times, WINDOW)
    fewer = Trajectory.unchecked(times, states, motion.joint_names)
    return fewer if max(fewer.use(limits).values()) <= 1.0 + ROUNDING else motion


def stops(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], stop: Callable[[], bool] = lambda: False
) -> tuple[Trajectory, float, str] | None:
    """Return the motion from corner to corner of a polyline, at rest at each.

    Along each straight line the arc length moves by Ruckig, within the tightest of the joints' limits divided by the
    joints' share of the direction, at the least jerk that takes 0.5 % longer than the largest one.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        stop: Called at every corner; True ends the search.

    Returns:
        The motion, its largest distance from the polyline [rad], and ``ruckig``; or None when ``stop`` returned True.

    Raises:
        TimingError: Ruckig finds no motion.
    """
    corners = line.corners()
    parts = []
    for start, end in zip(corners.states[:-1], corners.states[1:], strict=True):
        if stop():
            return None
        length = float(np.linalg.norm(end - start))
        direction = (end - start) / length
        moves = np.abs(direction) > 1e-12
        along = [float(np.min(getattr(limits, name)[moves] / np.abs(direction[moves]))) for name in DERIVATIVES]
        arc = _along_line(length, *along)
        positions = start + arc.positions * direction
        positions[0], positions[-1] = start, end
        parts.append(
            Trajectory(arc.times, positions, arc.velocities * direction, arc.accelerations * direction, joint_names)
        )
    deviation = float(np.linalg.norm(line.states - corners.at(line.arc), axis=1).max())
    return joined(parts), deviation, "ruckig"


def _along_line(length: float, velocity: float, acceleration: float, jerk: float) -> Trajectory:
    """Return the motion of the arc length along a straight line, from rest to rest, with merged knots.

    Args:
        length: Of the line [rad].
        velocity: Limit along the line [rad/s].
        acceleration: Limit [rad/s^2].
        jerk: Limit [rad/s^3].

    Raises:
        TimingError: Ruckig finds no motion.
    """
    solver, query, solution = ruckig.Ruckig(1), ruckig.InputParameter(1), ruckig.Trajectory(1)
    query.target_position = [length]
    share = LIMITS_SHARE
    while True:
        bounds = share * velocity, share * acceleration, least_jerk(length, velocity, acceleration, share * jerk)
        for name, bound in zip(DERIVATIVES, bounds, strict=True):
            setattr(query, f"max_{name}", [bound])
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError as error:
            shown = ", ".join(f"{name} {bound:.3g}" for name, bound in zip(DERIVATIVES, bounds, strict=True))
            raise TimingError(f"Ruckig finds no motion along a line of {length:.3g} rad within {shown}") from error
        times, *states = knots(solution)
        states[1][[0, -1]], states[2][[0, -1]] = 0.0, 0.0  # without rounding
        motion = Trajectory.unchecked(times, np.stack(states), ("arc",)).merged()
        *_, v, a, j = Extremes.of(*motion.knots)
        over = max(v[0] / velocity, a[0] / acceleration, j[0] / jerk)
        if over <= 1.0:
            return motion
        share *= LIMITS_SHARE / over


def least_jerk(length: float, velocity: float, acceleration: float, jerk: float) -> float:
    """Return the least jerk with which a straight motion from rest to rest takes 0.5 % longer than at the limit.

    With the ramps of the acceleration at least ``LEAST_SPACING`` long, it may take longer than that.

    Args:
        length: Of the line [rad].
        velocity: Limit along the line [rad/s].
        acceleration: Limit [rad/s^2].
        jerk: Limit [rad/s^3].
    """
    ramp = LEAST_SPACING
    high = min(jerk, acceleration / ramp, velocity / ramp**2, length / (2.0 * ramp**3))
    allowed = CALM_TIME * line_duration(length, velocity, acceleration, jerk)
    low = LEAST_JERK * high
    for _ in range(JERK_STEPS):
        middle = math.sqrt(low * high)
        if line_duration(length, velocity, acceleration, middle) <= allowed:
            high = middle
        else:
            low = middle
    return high


def line_duration(length: float, velocity: float, acceleration: float, jerk: float) -> float:
    """Return the least duration of a straight motion from rest to rest (Biagiotti and Melchiorri 2008, 3.4) [s].

    Args:
        length: Of the line [rad].
        velocity: Limit along the line [rad/s].
        acceleration: Limit [rad/s^2].
        jerk: Limit [rad/s^3].
    """
    rise = acceleration / jerk
    ramp = velocity / acceleration + rise if velocity >= acceleration * rise else 2.0 * math.sqrt(velocity / jerk)
    if length >= velocity * ramp:
        return length / velocity + ramp
    if length >= 2.0 * acceleration * rise**2:
        return rise + math.sqrt(rise**2 + 4.0 * length / acceleration)
    return 4.0 * math.cbrt(length / (2.0 * jerk))


def from_moving_start(
    velocity: Array, acceleration: Array, motion: Trajectory, limits: Limits, minimum_duration: float
) -> Iterator[tuple[Trajectory, float]]:
    """Yield motions that start with a velocity and join another motion, each with the time of joining [s].

    Args:
        velocity: Velocity at the start, shape (dof,) [rad/s].
        acceleration: Acceleration at the start, shape (dof,) [rad/s^2].
        motion: The motion to join, which starts from the same state at rest.
        limits: Limits of the joints.
        minimum_duration: Least duration of the whole motion [s].
    """
    chosen = np.searchsorted(motion.times, np.linspace(0.0, motion.duration, JOIN_TIMES + 1)[:-1])
    for k in [*distinct(chosen).tolist(), len(motion.times) - 1]:
        time = float(motion.times[k])
        left = motion.duration - time
        now = np.stack([motion.positions[0], velocity, acceleration])
        states = np.stack([now, motion.states(np.array([time]))[:, 0]], axis=1)
        head = _calm_head(states, limits, motion.joint_names, minimum_duration - left, (CALM_TIME - 1.0) * left)
        if head is not None:
            yield joined([head, motion.after(time)]), head.duration


def _calm_head(
    states: Array, limits: Limits, joint_names: tuple[str, ...], minimum_duration: float, longer: float
) -> Trajectory | None:
    """Return a motion between two states with merged knots, as calm as a somewhat longer duration allows, or None.

    Args:
        states: Positions, velocities and accelerations at start and end, shape (3, 2, dof).
        limits: Limits of the joints.
        joint_names: Names of the joints.
        minimum_duration: Least duration [s].
        longer: Time by which it may be longer, in addition to 0.5 % of its own [s].
    """
    for share in HEAD_SHARES:
        room = replace(limits, **{name: share * getattr(limits, name) for name in DERIVATIVES})
        made = between(states, room, joint_names, minimum_duration, limits)
        if made is None:
            continue
        allowed = CALM_TIME * made.duration + longer
        for calmer in CALMER:
            other = between(states, replace(room, jerk=calmer * room.jerk), joint_names, minimum_duration, limits)
            if other is None or other.duration > allowed:
                break
            made = other
        for spacing in HEAD_SPACINGS:
            merged = made.merged(spacing)
            if max(merged.use(limits).values()) <= 1.0 + ROUNDING:
                return merged
    return None


def between(
    states: Array, limits: Limits, joint_names: tuple[str, ...], minimum_duration: float = 0.0,
    outer: Limits | None = None,
) -> Trajectory | None:  # fmt: skip
    """Return Ruckig's motion between two states, the fastest in which all joints arrive together, or None.

    Args:
        states: Positions, velocities and accelerations at start and end, shape (3, 2, dof).
        limits: Limits of the joints. Ruckig ignores position limits; a motion beyond them is not returned.
        joint_names: Names of the joints.
        minimum_duration: Least duration [s].
        outer: Limits that the motion is checked for, where ``limits`` are lower than those of the given states.
    """
    solution = _solved(states, limits, minimum_duration)
    return None if solution is None else _within_limits([solution], states, outer or limits, joint_names)


def through(
    states: Array, limits: Limits, joint_names: tuple[str, ...], longest: float = np.inf,
    solving: Callable[[], None] = lambda: None,
) -> Trajectory | None:  # fmt: skip
    """Return Ruckig's motions between consecutive states, joined, or None.

    Args:
        states: Positions, velocities and accelerations, shape (3, N, dof).
        limits: Limits of the joints, see :func:`between`.
        joint_names: Names of the joints.
        longest: Upper bound on the duration [s].
        solving: Called before each of the N - 1 problems.
    """
    solutions, left = [], longest
    for k in range(states.shape[1] - 1):
        solving()
        one = _solved(states[:, k : k + 2], limits)
        if one is None or one.duration >= left:
            return None
        solutions.append(one)
        left -= one.duration
    return _within_limits(solutions, states, limits, joint_names)


def _solved(states: Array, limits: Limits, minimum_duration: float = 0.0) -> ruckig.Trajectory | None:
    """Return Ruckig's solution between two states, shape (3, 2, dof), or None."""
    dof = states.shape[2]
    solver, query, solution = ruckig.Ruckig(dof), ruckig.InputParameter(dof), ruckig.Trajectory(dof)
    (query.current_position, query.target_position), (query.current_velocity, query.target_velocity), (
        query.current_acceleration, query.target_acceleration
    ) = states.tolist()  # fmt: skip
    query.max_jerk = (JERK_SHARE * limits.jerk).tolist()
    for name, at in (("velocity", states[1]), ("acceleration", states[2])):
        least = LIMITS_MARGIN * np.abs(at).max(axis=0)  # with which Ruckig accepts the ends
        setattr(query, f"max_{name}", np.maximum(LIMITS_SHARE * getattr(limits, name), least).tolist())
    query.minimum_duration = max(minimum_duration, 0.0) or None
    try:
        calculate(solver, query, solution)
    except ruckig.RuckigError:  # that state cannot be reached from this velocity within the limits
        return None
    return solution


def _within_limits(
    solutions: list[ruckig.Trajectory], states: Array, limits: Limits, joint_names: tuple[str, ...]
) -> Trajectory | None:
    """Return solutions as one motion if it keeps the limits; Ruckig may exceed a limit that a velocity is near."""
    made = Profiles.of(solutions).joined(states, joint_names)
    return made if max(made.use(limits).values()) <= 1.0 + ROUNDING else None
