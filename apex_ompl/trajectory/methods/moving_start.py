"""Motions by Ruckig from a state that moves into a motion that starts at rest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import ruckig

from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.methods.ruckig import JERK_SHARE, LIMITS_MARGIN, LIMITS_SHARE
from apex_ompl.trajectory.methods.ruckig_profiles import Profiles, calculate, joined
from apex_ompl.trajectory.trajectory import ROUNDING, Trajectory, concatenate
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
    solver, query = ruckig.Ruckig(motion.dof), ruckig.InputParameter(motion.dof)
    query.current_position, query.current_velocity = motion.positions[0].tolist(), velocity.tolist()
    query.current_acceleration = acceleration.tolist()
    query.max_jerk = (JERK_SHARE * limits.jerk).tolist()
    for time in np.linspace(0.0, motion.duration, JOIN_TIMES + 1) if motion.duration else [0.0]:
        left = motion.duration - time
        target = [motion(time, order) for order in range(3)]
        query.target_position, query.target_velocity, query.target_acceleration = (x.tolist() for x in target)
        for name, *at in (("velocity", velocity, target[1]), ("acceleration", acceleration, target[2])):
            least = LIMITS_MARGIN * np.abs(at).max(axis=0)  # which Ruckig takes the ends with
            setattr(query, f"max_{name}", np.maximum(LIMITS_SHARE * getattr(limits, name), least).tolist())
        query.minimum_duration = max(minimum_duration - left, 0.0) or None
        solution = ruckig.Trajectory(motion.dof)
        try:
            calculate(solver, query, solution)
        except ruckig.RuckigError:  # that state cannot be reached from this velocity within the limits
            continue
        states = np.stack([[motion.positions[0], velocity, acceleration], target], axis=1)
        head = joined(Profiles.of([solution]), states, motion.joint_names)
        if max(head.use(limits).values()) <= 1.0 + ROUNDING:  # Ruckig may exceed a limit that the velocity is near to
            yield concatenate([head, motion.after(time)]), head.duration
