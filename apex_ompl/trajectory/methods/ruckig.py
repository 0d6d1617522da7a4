"""Motions by Ruckig (Berscheid and Kroeger 2021): blended ones, stops at corners, and moving starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import ruckig

from apex_ompl.errors import TimingError
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.curve import Polyline
from apex_ompl.trajectory.deviation import deviation_bound
from apex_ompl.trajectory.methods.spline import blend
from apex_ompl.trajectory.trajectory import ROUNDING, Trajectory, concatenate
from apex_ompl.types import Array

LIMITS_SHARE = 1.0 - 1e-6  # of the limits that Ruckig is given, for its rounding
JERK_SHARE = 1.0 - 1e-5  # of the limit which leaves room for rounding
LIMITS_MARGIN = 1.0 + 1e-10  # on the limits where Ruckig is given states that are at them
JOIN_TIMES = 12  # intervals of a motion at whose ends a moving start may join it
SHORTEST_PIECE = 1e-9  # [s]
STILL = 1e-12  # range of a joint that stays [rad]
STRIDES = (2, 1)  # of the knots of a spline that Ruckig's motion goes through; the first that keeps the deviation
TICK = 1e-9  # of the times at which the jerk changes [s]
SLOWEST = 1.02  # duration as a multiple of the guide's
SPLITS = 4  # parts of each profile, so that three jerks at least can be corrected
DERIVATIVES = ("velocity", "acceleration", "jerk")


def blended(
    line: Polyline, limits: Limits, joint_names: tuple[str, ...], deviation: float,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Trajectory, float] | None:  # fmt: skip
    """Return Ruckig's motion along a polyline, its corners rounded.

    The states of the fastest spline in time (:func:`apex_ompl.trajectory.methods.spline.blend`) at every second knot
    are targets of Ruckig's state-to-state problems in all joints, each with the time between its knots as the least
    duration. The spline itself solves them within the limits, so that Ruckig's motion takes no longer but for rounding.
    Where it leaves the polyline too far, or the position limits, which Ruckig does not know, or is slower (there may be
    durations in which no motion between two states exists), it goes through all of the knots.

    Args:
        line: The polyline, of positive length.
        limits: Limits of the joints.
        joint_names: Names of the joints, in the order of the columns.
        deviation: Largest distance of the motion from the polyline [rad].
        stop: Asked before every state-to-state problem whether to give up.

    Returns:
        The motion and a bound on its distance from the polyline [rad], or None where none keeps ``deviation``, or when
        told to stop meanwhile.
    """
    guide = blend(line, limits, joint_names, deviation, stop)
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
        stop: Asked before every state-to-state problem whether to give up.

    Returns:
        The motion, or None where Ruckig finds none or is told to stop.
    """
    chosen = np.unique([*range(0, len(guide.times), stride), len(guide.times) - 1])
    solver, query = ruckig.Ruckig(guide.dof), ruckig.InputParameter(guide.dof)
    for name, share in zip(DERIVATIVES, (LIMITS_MARGIN, LIMITS_MARGIN, JERK_SHARE), strict=True):
        setattr(query, f"max_{name}", (share * getattr(limits, name)).tolist())
    states = np.stack([guide.positions[chosen], guide.velocities[chosen], guide.accelerations[chosen]])
    still = np.ptp(guide.positions, axis=0) <= STILL  # by rounding alone, which Ruckig would follow
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
        if any(profile.brake.duration > 0.0 for profile in solution.profiles[0]):  # a state is over a limit
            return None
        solutions.append(solution)
    return _within(_joined(solutions, states, guide), limits)


def _within(motion: Trajectory, limits: Limits) -> Trajectory:
    """Return a motion slowed down by what it uses over the limits through rounding."""
    use = motion.use(limits)
    over = max(use[name] ** (1.0 / order) for order, name in enumerate(DERIVATIVES, 1))
    return motion if over <= 1.0 else motion.slower(over * (1.0 + ROUNDING))


def _joined(solutions: Sequence[ruckig.Trajectory], states: Array, guide: Trajectory) -> Trajectory:
    """Return solutions one after the other as one trajectory; its knots are where the jerk of any joint changes.

    Args:
        solutions: The solutions.
        states: Positions, velocities and accelerations between which they go, shape (3, K + 1, dof).
        guide: Motion with their ends and joint names.
    """
    profiles = [solution.profiles[0] for solution in solutions]
    own = np.array([[profile.t for profile in row] for row in profiles])  # durations of the phases, (K, dof, PHASES)
    jerks = np.where(own > 0.0, [[profile.j for profile in row] for row in profiles], 0.0)
    starts = np.cumsum([0.0, *(solution.duration for solution in solutions)])
    first, last = starts[:-1, None, None], starts[1:, None, None]
    begins = np.minimum(first + np.cumsum(own, axis=2) - own, last)
    splits = first + (last - first) * np.arange(1, SPLITS) / SPLITS
    both = np.sort(np.append(begins, np.broadcast_to(splits, (*own.shape[:2], SPLITS - 1)), axis=2), axis=2)
    phase = (begins[..., None, :] <= both[..., None]).sum(axis=3) - 1
    jerk = np.take_along_axis(jerks, phase, axis=2)
    both, starts = np.round(both / TICK) * TICK, np.round(starts / TICK) * TICK
    begins = both.clip(starts[:-1, None, None], starts[1:, None, None])
    begins[..., 0] = starts[:-1, None]
    lasts = np.diff(begins, axis=2, append=np.broadcast_to(starts[1:, None, None], (*own.shape[:2], 1)))
    jerk = exact_jerks(lasts, jerk, states)
    at = np.empty((3, *lasts.shape))  # state at the beginning of each phase
    q, v, a = states[:, :-1]
    for k in range(lasts.shape[2]):
        at[..., k] = q, v, a
        t, j = lasts[..., k], jerk[..., k]
        q, v, a = q + t * (v + t * (a / 2.0 + t * j / 6.0)), v + t * (a + t * j / 2.0), a + t * j
    times = np.unique(np.append(begins, starts))
    times = times[np.append(True, np.diff(times) > TICK / 2.0)]
    rows = begins.transpose(1, 0, 2).reshape(guide.dof, -1)  # phases by joint
    place = np.stack([np.searchsorted(mine, times, side="right") - 1 for mine in rows])
    since = times - np.take_along_axis(rows, place, axis=1)
    q, v, a, j = (
        np.take_along_axis(values.transpose(1, 0, 2).reshape(guide.dof, -1), place, axis=1) for values in (*at, jerk)
    )
    slope = a + since * j
    knots_at = np.stack([q + since * (v + since * (2.0 * a + slope) / 6.0), v + since * (a + slope) / 2.0, slope])
    knots_at = np.ascontiguousarray(knots_at.transpose(0, 2, 1))
    knots_at[:, [0, -1]] = states[:, [0, -1]]
    return Trajectory(times, knots_at[0], knots_at[1], knots_at[2], guide.joint_names)


def exact_jerks(lasts: Array, jerk: Array, states: Array) -> Array:
    """Return jerks with which profiles of given phases go from state to state exactly.

    Ruckig ends its search 1e-8 from the target or nearer, and the phases are rounded to ``TICK``. The state at the end
    is linear in the jerks: the least change of them is taken that removes what is missing there.

    Args:
        lasts: Durations of the phases, shape (K, dof, phases) [s].
        jerk: Ruckig's jerks, likewise [rad/s^3].
        states: Positions, velocities and accelerations at the ends, shape (3, K + 1, dof).
    """
    after = (
        np.cumsum(lasts[..., ::-1], axis=2)[..., ::-1] - lasts
    )  # time from the end of a phase to that of the profile
    whole = np.maximum(lasts.sum(axis=2), SHORTEST_PIECE)[..., None]
    gains = np.stack([
        lasts * (after**2 / 2.0 + after * lasts / 2.0 + lasts**2 / 6.0) / whole**3,
        lasts * (after + lasts / 2.0) / whole**2, lasts / whole,
    ], axis=2)  # fmt: skip
    q, v, a = states[:, :-1]
    t = whole[..., 0]
    free = np.stack([q + t * (v + t * a / 2.0), v + t * a, a], axis=2)  # without jerk
    wanted = np.stack([states[0, 1:], states[1, 1:], states[2, 1:]], axis=2) - free
    wanted = wanted / np.stack([t**3, t**2, t], axis=2)
    missing = wanted - (gains @ jerk[..., None])[..., 0]
    square = gains @ gains.transpose(0, 1, 3, 2) + 1e-14 * np.eye(3)
    change = gains.transpose(0, 1, 3, 2) @ np.linalg.solve(square, missing[..., None])
    return np.asarray(jerk + change[..., 0])


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
        stop: Asked at every corner whether to give up.

    Returns:
        The motion and its largest distance from the polyline [rad], or None when told to stop meanwhile.

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
            raise TimingError(f"Ruckig finds no motion along a line of {length:.3g} rad, {error}") from error
        times, arc, speed, acceleration = knots(solution)
        positions = start + arc * direction
        positions[0], positions[-1] = start, end
        speed[[0, -1]], acceleration[[0, -1]] = 0.0, 0.0  # without rounding
        parts.append(Trajectory(times, positions, speed * direction, acceleration * direction, joint_names))
    return concatenate(parts), float(np.linalg.norm(line.states - corners.at(line.arc), axis=1).max())


def from_moving_start(
    velocity: Array, acceleration: Array, motion: Trajectory, limits: Limits, minimum_duration: float
) -> Iterator[tuple[Trajectory, float]]:
    """Yield motions that start with a velocity and join another motion, and the time of joining [s].

    Args:
        velocity: Velocity at the start, shape (dof,) [rad/s].
        acceleration: Acceleration at the start, shape (dof,) [rad/s^2].
        motion: The motion to join, which starts from the same state at rest.
        limits: Limits of the joints.
        minimum_duration: Least duration of the whole motion [s].
    """
    solver, query = ruckig.Ruckig(motion.dof), ruckig.InputParameter(motion.dof)
    query.current_position, query.current_velocity = motion.positions[0].tolist(), velocity.tolist()
    query.current_acceleration = acceleration.tolist()
    for name in DERIVATIVES:
        setattr(query, f"max_{name}", (LIMITS_MARGIN * getattr(limits, name)).tolist())
    for time in np.linspace(0.0, motion.duration, JOIN_TIMES + 1) if motion.duration else [0.0]:
        left = motion.duration - time
        query.target_position, query.target_velocity, query.target_acceleration = (
            motion(time, order).tolist() for order in range(3)
        )
        query.minimum_duration = max(minimum_duration - left, 0.0) or None
        solution = ruckig.Trajectory(motion.dof)
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError:  # that state cannot be reached from this velocity within the limits
            continue
        head = _head(solution, motion, time)
        if max(head.use(limits).values()) <= 1.0 + ROUNDING:  # Ruckig may exceed a limit that the velocity is near to
            yield concatenate([head, motion.after(time)]), head.duration


def _head(solution: ruckig.Trajectory, motion: Trajectory, time: float) -> Trajectory:
    """Return Ruckig's motion to the state of another motion at a time [s], without rounding at both ends."""
    times, *states = knots(solution)
    states[0][0] = motion.positions[0]
    for order, values in enumerate(states):
        values[-1] = motion(time, order)
    return Trajectory(times, states[0], states[1], states[2], motion.joint_names)


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
