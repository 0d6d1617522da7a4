"""Point to point by Ruckig: stops at corners, and what a moving start needs to join a motion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import ruckig

from apex_ompl.errors import TimingError
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.motion import ROUNDING, Trajectory, joined
from apex_ompl.types import Array

WITHIN = 1.0 - 1e-6  # of the limits that Ruckig is given, for its rounding
BEYOND = 1.0 + 1e-10  # where it is given states that are at the limits
JOINTS = 12  # places at which a motion may be joined
SHORTEST = 1e-9  # piece [s]


def stops(corners: Array, limits: Limits, names: tuple[str, ...]) -> Trajectory:
    """Return the fastest motion from corner to corner, at rest at each, shape (n, dof) with n of 2 or more.

    Along each straight line one number moves, by Ruckig with the limits of the joint that has the least.

    Raises:
        TimingError: Ruckig finds none.
    """
    parts = []
    solver, task, made = ruckig.Ruckig(1), ruckig.InputParameter(1), ruckig.Trajectory(1)
    for start, end in zip(corners[:-1], corners[1:], strict=True):
        length = float(np.linalg.norm(end - start))
        direction = (end - start) / length
        moves = np.abs(direction) > 1e-12
        task.target_position = [length]
        for name in ("velocity", "acceleration", "jerk"):
            most = WITHIN * np.min(getattr(limits, name)[moves] / np.abs(direction[moves]))
            setattr(task, f"max_{name}", [float(most)])
        try:
            calculate(solver, task, made)
        except ruckig.RuckigError as error:
            raise TimingError(f"Ruckig finds no motion along a line of {length:.3g} rad, {error}") from error
        times, place, speed, push = knots(made)
        positions = start + place * direction
        positions[0], positions[-1] = start, end
        speed[[0, -1]], push[[0, -1]] = 0.0, 0.0  # of rounding
        parts.append(Trajectory(times, positions, speed * direction, push * direction, names))
    return joined(parts)


def from_motion(
    velocity: Array, acceleration: Array, rest: Trajectory, limits: Limits, minimum_duration: float
) -> Iterator[tuple[Trajectory, float]]:
    """Yield motions that begin with a velocity and go over into another motion from the same state, and when they do.

    Args:
        velocity: At the start, shape (dof,) [rad/s].
        acceleration: At the start [rad/s^2].
        rest: The motion from rest.
        limits: Of the joints.
        minimum_duration: Of the whole [s].
    """
    solver, task = ruckig.Ruckig(rest.dof), ruckig.InputParameter(rest.dof)
    task.current_position, task.current_velocity = rest.positions[0].tolist(), velocity.tolist()
    task.current_acceleration = acceleration.tolist()
    for name in ("velocity", "acceleration", "jerk"):
        setattr(task, f"max_{name}", (BEYOND * getattr(limits, name)).tolist())
    for moment in np.linspace(0.0, rest.duration, JOINTS + 1) if rest.duration else [0.0]:
        left = rest.duration - moment
        task.target_position, task.target_velocity, task.target_acceleration = (
            rest(moment, order).tolist() for order in range(3)
        )
        task.minimum_duration = max(minimum_duration - left, 0.0) or None
        made = ruckig.Trajectory(rest.dof)
        try:
            calculate(solver, task, made)
        except ruckig.RuckigError:  # from this velocity that state cannot be reached within the limits
            continue
        head = _head(made, rest, moment)
        if max(head.use(limits).values()) <= 1.0 + ROUNDING:  # from a velocity near its limit Ruckig may go over it
            yield joined([head, rest.after(moment)]), head.duration


def _head(made: ruckig.Trajectory, rest: Trajectory, moment: float) -> Trajectory:
    """Return Ruckig's motion to where another one is at a moment."""
    times, *states = knots(made)
    states[0][0] = rest.positions[0]
    for order, part in enumerate(states):
        part[-1] = rest(moment, order)
    return Trajectory(times, states[0], states[1], states[2], rest.joint_names)


def calculate(solver: ruckig.Ruckig, task: ruckig.InputParameter, made: ruckig.Trajectory) -> None:
    """Solve a task of Ruckig's.

    Raises:
        RuckigError: It has no solution.
    """
    try:
        result = solver.calculate(task, made)
    except ValueError as error:  # a result that the bindings have no name for
        raise ruckig.RuckigError(str(error)) from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise ruckig.RuckigError(str(result))


def knots(made: ruckig.Trajectory) -> tuple[Array, Array, Array, Array]:
    """Return the moments between which all joints have constant jerk, ends included, and the states then.

    Returns:
        Times of shape (K,) [s]; positions, velocities and accelerations of shape (K, dof).
    """
    found = [0.0, made.duration]
    for profile in made.profiles[0]:
        brake = np.cumsum(profile.brake.t)
        found += [*brake, *(profile.brake.duration + np.cumsum(profile.t))]
    times = np.unique(np.clip(found, 0.0, made.duration))
    times = times[np.append(True, np.diff(times) > SHORTEST)]
    if len(times) > 1:
        times[-1] = made.duration
    q, v, a = (np.array(part) for part in zip(*(made.at_time(float(t)) for t in times), strict=True))
    return times, q, v, a
