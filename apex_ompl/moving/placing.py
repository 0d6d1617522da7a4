"""A checker of its own for a way of replanning, into which it places what moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.moving.dynamic_obstacles import clearance_in_time
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.search import Search, least_duration
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing, vector
from apex_ompl.types import Array

LOOKS = 16  # at the straight line, to see where an obstacle comes nearest


def fresh_checker(ready: Ready) -> CollisionChecker:
    """Return a checker of what stands still."""
    setup = ready.setup
    return CollisionChecker(setup.robot, setup.problem.scene, setup.problem.attached, setup.problem.allowed)


def place(checker: CollisionChecker, obstacle: Obstacle, position: ArrayLike) -> None:
    """Let an obstacle stand at a position, shape (3,) [m], as one that does not move."""
    if checker.is_obstacle(obstacle.name):
        checker.move(obstacle.name, vector(position))
    else:
        checker.add(standing(obstacle).model_copy(update={"position": vector(position)}))


def place_nearest(checker: CollisionChecker, search: Search, goal: Array) -> None:
    """Let each obstacle stand where it is when one comes nearest to the straight motion to a goal, shape (dof,)."""
    request = search.request
    line = np.linspace(search.start.position, goal, LOOKS)
    duration = least_duration(line, search.ready.limits)
    times = request.join + np.linspace(0.0, duration, LOOKS)
    clear, _ = clearance_in_time(search.ready.kernel, request.predicted, line, times)
    nearest = float(times[int(np.argmin(clear))])
    search.charges.charge("clearance in time", LOOKS)
    for o in request.obstacles:
        way = np.multiply(o.velocity or (0.0, 0.0, 0.0), nearest - request.asked)
        place(checker, o, np.add(o.position, way))
