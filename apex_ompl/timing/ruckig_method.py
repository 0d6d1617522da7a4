"""Motions by Ruckig (Berscheid and Kroeger 2021): blended ones, stops at corners, and motions from a moving start."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
import ruckig

from apex_ompl.errors import TimingError
from apex_ompl.kernel.timing import TICK, join_profiles
from apex_ompl.robot.model import Limits
from apex_ompl.timing.curve import Polyline, deviation_bound
from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.spline_method import blend
from apex_ompl.timing.trajectory import ROUNDING, Trajectory, concatenate
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct

SHORTEST_PIECE = 1e-9  # [s]
LIMITS_SHARE = 1.0 - 1e-6  # share of the limits that Ruckig is given, for its rounding
JERK_SHARE = 1.0 - 1e-5  # share of the jerk limit, which leaves room for rounding
LIMITS_MARGIN = 1.0 + 1e-10  # factor on the limits where the given states are at them
STILL = 1e-12  # range of a joint that stays [rad]
STRIDES = (2, 1)  # of the knots of a spline that Ruckig's motion goes through; the first that keeps the deviation
SLOWEST = 1.02  # duration as a multiple of the guide's
DERIVATIVES = ("velocity", "acceleration", "jerk")
JOIN_TIMES = 12  # intervals of a motion at whose ends a moving start may join it


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
    times = np.unique(np.clip(changes, 0.0, solution.duration))
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


def joined(profiles: Profiles, states: Array, joint_names: tuple[str, ...]) -> Trajectory:
    """Return consecutive motions as one trajectory that goes through given states exactly.

    Its knots are where the jerk of any joint changes.

    Args:
        profiles: The motions.
        states: Positions, velocities and accelerations at their ends, shape (3, K + 1, dof).
        joint_names: Names of the joints.
    """
    starts = np.round(np.cumsum([0.0, *profiles.durations]) / TICK).astype(np.int64)
    return Trajectory.unchecked(*join_profiles(profiles.phases, profiles.jerks, starts, states), joint_names)


def blended(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], deviation: float,
    stop: Callable[[], bool] = lambda: False, *, more: MotionLimits | None = None,
) -> tuple[Trajectory, float] | None:  # fmt: skip
    """Return Ruckig's motion along a polyline, its corners rounded.

    The states of the fastest spline in time (:func:`apex_ompl.timing.spline_method.blend`) at every second knot
    are targets of Ruckig's state-to-state problems in all joints, each with the time between its knots as the least
    duration. The spline itself solves them within the limits, so that Ruckig's motion takes no longer but for rounding.
    Where the motion leaves the polyline too far, or the position limits, which Ruckig ignores, or is slower (there may
    be durations in which no motion between two states exists), all of the knots are targets.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        deviation: Largest distance of the motion from the polyline [rad].
        stop: Called before every state-to-state problem; True ends the search.
        more: Limits of torques and tool speeds, see :func:`apex_ompl.timing.spline_method.blend`.

    Returns:
        The motion and a bound on its distance from the polyline [rad], or None where none keeps ``deviation``, or when
        ``stop`` returned True.
    """
    room = {name: LIMITS_SHARE * getattr(limits, name) for name in ("velocity", "acceleration")}
    guide = blend(line, replace(limits, **room), joint_names, deviation, stop, more=more)
    if guide is None:
        return None
    knot_times, arc = guide.arc_at
    for stride in STRIDES:
        motion = through_knots(guide.trajectory, limits, stride, stop)
        if motion is None or motion.use(limits)["position"] > 1.0 + ROUNDING:
            continue
        if motion.duration > SLOWEST * guide.trajectory.duration:
            continue
        times = knot_times * (motion.duration / guide.trajectory.duration)
        bound = deviation_bound(motion, line, (times, arc), guide.window, deviation, stop=stop)
        if bound <= deviation:
            return motion, bound
    return None


def through_knots(
    guide: Trajectory, limits: Limits, stride: int, stop: Callable[[], bool] = lambda: False
) -> Trajectory | None:
    """Return Ruckig's motion through every ``stride``-th knot of another motion, in its time.

    Args:
        guide: Motion within the limits.
        limits: Limits of the joints.
        stride: Of the knots; the ends are among them.
        stop: Called before every state-to-state problem; True ends the search.

    Returns:
        The motion, or None where Ruckig finds none or ``stop`` returned True.
    """
    chosen = distinct([*range(0, len(guide.times), stride), len(guide.times) - 1])
    solver, query = ruckig.Ruckig(guide.dof), ruckig.InputParameter(guide.dof)
    for name, share in zip(DERIVATIVES, (LIMITS_MARGIN, LIMITS_MARGIN, JERK_SHARE), strict=True):
        setattr(query, f"max_{name}", (share * getattr(limits, name)).tolist())
    states = np.stack([guide.positions[chosen], guide.velocities[chosen], guide.accelerations[chosen]])
    still = np.ptp(guide.positions, axis=0) <= STILL  # up to rounding, which Ruckig would follow
    states[0][:, still], states[1:, :, still] = guide.positions[0, still], 0.0
    rows = states.tolist()
    solutions = []
    for k, least in enumerate(np.diff(guide.times[chosen]).tolist()):
        if stop():
            return None
        query.current_position, query.current_velocity, query.current_acceleration = (values[k] for values in rows)
        query.target_position, query.target_velocity, query.target_acceleration = (values[k + 1] for values in rows)
        query.minimum_duration = least
        solution = ruckig.Trajectory(guide.dof)
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError:
            return None
        solutions.append(solution)
    profiles = Profiles.of(solutions)
    return None if profiles.brakes else _within(joined(profiles, states, guide.joint_names), limits)


def _within(motion: Trajectory, limits: Limits) -> Trajectory:
    """Return a motion slowed down until rounding takes it over no limit."""
    use = motion.use(limits)
    over = max(use[name] ** (1.0 / order) for order, name in enumerate(DERIVATIVES, 1))
    return motion if over <= 1.0 else motion.slower(over * (1.0 + ROUNDING))


def stops(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], stop: Callable[[], bool] = lambda: False
) -> tuple[Trajectory, float] | None:
    """Return the fastest motion from corner to corner of a polyline, at rest at each.

    Along each straight line the arc length moves by Ruckig, within the tightest of the joints' limits divided by the
    joints' share of the direction.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        stop: Called at every corner; True ends the search.

    Returns:
        The motion and its largest distance from the polyline [rad], or None when ``stop`` returned True.

    Raises:
        TimingError: Ruckig finds no motion.
    """
    corners = line.corners()
    parts = []
    solver, query, solution = ruckig.Ruckig(1), ruckig.InputParameter(1), ruckig.Trajectory(1)
    for start, end in zip(corners.states[:-1], corners.states[1:], strict=True):
        if stop():
            return None
        length = float(np.linalg.norm(end - start))
        direction = (end - start) / length
        moves = np.abs(direction) > 1e-12
        query.target_position = [length]
        for name in DERIVATIVES:
            limit = LIMITS_SHARE * np.min(getattr(limits, name)[moves] / np.abs(direction[moves]))
            setattr(query, f"max_{name}", [float(limit)])
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError as error:
            limit = ", ".join(f"{name} {getattr(query, f'max_{name}')[0]:.3g}" for name in DERIVATIVES)
            raise TimingError(f"Ruckig finds no motion along a line of {length:.3g} rad within {limit}") from error
        times, arc, speed, acceleration = knots(solution)
        positions = start + arc * direction
        positions[0], positions[-1] = start, end
        speed[[0, -1]], acceleration[[0, -1]] = 0.0, 0.0  # without rounding
        parts.append(Trajectory(times, positions, speed * direction, acceleration * direction, joint_names))
    return concatenate(parts), float(np.linalg.norm(line.states - corners.at(line.arc), axis=1).max())


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
    for time in np.linspace(0.0, motion.duration, JOIN_TIMES + 1) if motion.duration else [0.0]:
        left = motion.duration - time
        now = np.stack([motion.positions[0], velocity, acceleration])
        states = np.stack([now, motion.states(np.array([time]))[:, 0]], axis=1)
        head = between(states, limits, motion.joint_names, minimum_duration - left)
        if head is not None:
            yield concatenate([head, motion.after(time)]), head.duration


def between(
    states: Array, limits: Limits, joint_names: tuple[str, ...], minimum_duration: float = 0.0
) -> Trajectory | None:
    """Return Ruckig's motion between two states, the fastest in which all joints arrive together, or None.

    Args:
        states: Positions, velocities and accelerations at start and end, shape (3, 2, dof).
        limits: Limits of the joints. Ruckig ignores position limits; a motion beyond them is not returned.
        joint_names: Names of the joints.
        minimum_duration: Least duration [s].
    """
    solution = _solved(states, limits, minimum_duration)
    return None if solution is None else _within_limits([solution], states, limits, joint_names)


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
    made = joined(Profiles.of(solutions), states, joint_names)
    return made if max(made.use(limits).values()) <= 1.0 + ROUNDING else None
