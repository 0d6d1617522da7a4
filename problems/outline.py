"""What a suite draws: a problem in arrays, and the problem made of it."""

from __future__ import annotations

from dataclasses import dataclass

from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.types import Array


@dataclass(frozen=True, eq=False)
class Outline:
    """A scene, held objects, and the states to go between.

    Attributes:
        scene: Obstacles.
        start: Shape (dof,).
        goal: Shape (dof,).
        attached: Held objects.
    """

    scene: tuple[Obstacle, ...]
    start: Array
    goal: Array
    attached: tuple[AttachedObject, ...] = ()

    def problem(self, name: str, robot: Robot) -> Problem:
        """Return the problem by a name, for the robot that it was drawn for."""
        start, goal = (dict(zip(robot.joint_names, q.tolist(), strict=True)) for q in (self.start, self.goal))
        return Problem(
            name=name, robot=robot.name, scene=self.scene, attached=self.attached, start=start,
            goal=Goal(joints=(goal,)),
        )  # fmt: skip
