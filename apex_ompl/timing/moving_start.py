"""Motions by Ruckig from a state that moves into a motion that starts at rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import ruckig

from apex_ompl.robot.model import Limits
from apex_ompl.timing.ruckig_method import JERK_SHARE, LIMITS_MARGIN, LIMITS_SHARE
from apex_ompl.timing.ruckig_profiles import Profiles, calculate, joined
from apex_ompl.timing.trajectory import ROUNDING, Trajectory, concatenate
from apex_ompl.types import Array

JOIN_TIMES = 12  # intervals of a motion at whose ends a moving start may join it


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
        states: Positions, velocities and accelerations at begin and end, shape (3, 2, dof).
        limits: Limits of the joints. Ruckig does not know those of positions, but a motion beyond them is none.
        joint_names: Names of the joints.
        minimum_duration: Least duration [s].
    """
    solution = _solved(states, limits, minimum_duration)
    return None if solution is None else _within_limits([solution], states, limits, joint_names)


def through(
    states: Array, limits: Limits, joint_names: tuple[str, ...], longest: float = np.inf,
    solving: Callable[[], None] = lambda: None,
) -> Trajectory | None:  # fmt: skip
    """Return Ruckig's motions between some states one after the other, or None.

    Args:
        states: Positions, velocities and accelerations, shape (3, N, dof).
        limits: As in :func:`between`.
        joint_names: Names of the joints.
        longest: Duration that it must be shorter than [s].
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
        least = LIMITS_MARGIN * np.abs(at).max(axis=0)  # which Ruckig takes the ends with
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
    """Return solutions as one motion, if it keeps the limits: Ruckig may exceed one that the velocity is near to."""
    made = joined(Profiles.of(solutions), states, joint_names)
    return made if max(made.use(limits).values()) <= 1.0 + ROUNDING else None
