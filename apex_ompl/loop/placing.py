"""A checker of its own for a way of replanning, into which it places what moves."""

from __future__ import annotations

from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.loop.ready import Ready
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import standing, vector


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
