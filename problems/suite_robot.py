"""The robot of the suites, and a problem as the generators of the suites draw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.problems.broad_representation import Group, given
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.constraints import AnyConstraint
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.types import Array

ROBOT = "dual_panda_softhand"
MARGIN = 0.01  # clearance of every start and goal [m]
COLUMNS = np.array([[0.0, 0.5], [0.0, -0.5]]), np.full((2, 2), 0.21)
"""Centers of columns above the arms' bases, and their half widths along x and y, shape (2, 2) [m]."""
STAYING = ("link0", "link1", "link2")  # ends of the names of links that stay in these columns and cannot evade
LOW, HIGH = np.array([-0.2, -0.6, 0.1]), np.array([0.6, 0.6, 0.9])  # of the places of held objects [m]


def robot() -> Robot:
    """Return the robot of the suites."""
    return load_robot(ROBOT)


@dataclass(frozen=True, eq=False)
class DrawnProblem:
    """Obstacles, held objects, and a start and a goal in the order of the robot's joints.

    Attributes:
        scene: Obstacles; primitives where there are ``groups``.
        start: Shape (dof,).
        goal: Shape (dof,).
        attached: Held objects.
        groups: Obstacles, by their index in ``scene``, that are given as a mesh or as points.
        constraints: What holds along a path, beside the chains that objects in two hands close.
    """

    scene: tuple[Obstacle, ...]
    start: Array
    goal: Array
    attached: tuple[AttachedObject, ...] = ()
    groups: tuple[Group, ...] = ()
    constraints: tuple[AnyConstraint, ...] = ()

    def to_problem(self, name: str, robot: Robot) -> Problem:
        """Return the problem under a name, for the robot that it was drawn for."""
        start, goal = (dict(zip(robot.joint_names, q.tolist(), strict=True)) for q in (self.start, self.goal))
        return Problem(
            name=name, robot=robot.name, scene=given(self.scene, self.groups), attached=self.attached, start=start,
            goal=Goal(joints=(goal,)), constraints=self.constraints,
        )  # fmt: skip
