"""Curves of a timed motion over time: its use of limits, and its clearance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there, obstacle_at
from apex_ompl.timing import Trajectory
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
    center, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
    bounds = (limits.velocity, limits.acceleration, limits.jerk)
    scaled = [(motion(times) - center) / half]
    return np.stack([*scaled, *(motion(times, order) / bound for order, bound in enumerate(bounds, 1))])


def clearances(checker: CollisionChecker, motion: Trajectory, times: Array, dynamic: Sequence[Obstacle] = ()) -> Array:
    """Return the clearance of a motion at some times, shape (N,) [m].

    Args:
        checker: The robot in its scene.
        motion: The motion.
        times: Shape (N,) [s].
        dynamic: Obstacles of the scene that move; those that have appeared are where they are at each time.
    """
    found, among = [], dict[frozenset[str], CollisionChecker]()
    for time, q in zip(times.tolist(), motion(times), strict=True):
        here = [obstacle_at(dynamic_obstacle, time) for dynamic_obstacle in dynamic if is_there(dynamic_obstacle, time)]
        names = frozenset(dynamic_obstacle.name for dynamic_obstacle in here)
        if names not in among:
            among[names] = _among(checker, dynamic, here)
        for dynamic_obstacle in here:
            among[names].move(dynamic_obstacle.name, dynamic_obstacle.position)
        found.append(among[names].clearance(q))
    return np.array(found)


def _among(checker: CollisionChecker, dynamic: Sequence[Obstacle], here: Sequence[Obstacle]) -> CollisionChecker:
    """Return a checker with those of the dynamic obstacles that are there."""
    if not dynamic:
        return checker
    names, present = (
        {dynamic_obstacle.name for dynamic_obstacle in dynamic},
        {dynamic_obstacle.name for dynamic_obstacle in here},
    )
    scene = [*(o for o in checker.obstacles.values() if o.name not in names), *here]
    pairs = [pair for pair in checker.allowed if not {*pair} & (names - present)]
    return CollisionChecker(checker.robot, scene, checker.held.values(), pairs)
