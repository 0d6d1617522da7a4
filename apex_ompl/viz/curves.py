"""Curves of a timed motion over time: its use of limits, and its clearance."""

from __future__ import annotations

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.robot import Robot
from apex_ompl.trajectory import Trajectory
from apex_ompl.types import Array

ORDERS = ("position", "velocity", "acceleration", "jerk")


def shares_of_limits(motion: Trajectory, robot: Robot, times: Array) -> Array:
    """Return position, velocity, acceleration and jerk as shares of the limits, shape (4, N, dof).

    1 is the upper limit, -1 the lower one.

    Args:
        motion: The motion.
        robot: Its robot.
        times: Shape (N,) [s].
    """
    limits = robot.limits
    centre, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
    bounds = (limits.velocity, limits.acceleration, limits.jerk)
    scaled = [(motion(times) - centre) / half]
    return np.stack([*scaled, *(motion(times, order) / bound for order, bound in enumerate(bounds, 1))])


def clearances(checker: CollisionChecker, states: Array) -> Array:
    """Return the clearance of each state of shape (N, dof), shape (N,) [m]."""
    return np.array([checker.clearance(q) for q in states])
