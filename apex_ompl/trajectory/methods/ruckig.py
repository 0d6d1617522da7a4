"""Point-to-point motions by Ruckig (Berscheid and Kroeger 2021): stops at corners, and moving starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import ruckig

from apex_ompl.errors import TimingError
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.curve import Polyline
from apex_ompl.trajectory.trajectory import ROUNDING, Trajectory, concatenate
from apex_ompl.types import Array

LIMITS_SHARE = 1.0 - 1e-6  # of the limits that Ruckig is given, for its rounding
LIMITS_MARGIN = 1.0 + 1e-10  # on the limits where Ruckig is given states that are at them
JOIN_TIMES = 12  # intervals of a motion at whose ends a moving start may join it
SHORTEST_PIECE = 1e-9  # [s]
DERIVATIVES = ("velocity", "acceleration", "jerk")


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
