"""Goals of the motions of a task, in the world in which each starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.tables import with_range
from apex_ompl.goals.alignment import AlignmentGoal, within
from apex_ompl.goals.any_goal import AnyGoal
from apex_ompl.goals.goal_sampling import TOLERANCE
from apex_ompl.goals.pose_goal import PoseGoal
from apex_ompl.ompl.setup import held_range, workspace_goal
from apex_ompl.planning.query import Group, planned_joints
from apex_ompl.planning.task_world import TaskWorld
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import MoveStep, Problem
from apex_ompl.types import Array

NEAR = 0.05  # distance of a state that was rehearsed from one that reaches the goal exactly [rad]


@dataclass(frozen=True, eq=False)
class TaskGoal:
    """The goal of a motion.

    Attributes:
        problem: The problem of the motion.
        robot: The robot, whose joints that stay have narrow limits.
        start: The start, shape (dof,).
        goal: The goal in the workspace, or None.
        states: The goal as joint configurations, shape (N, dof).
        held: Numbers of the joints that stay.
    """

    problem: Problem
    robot: Robot
    start: Array
    goal: AlignmentGoal | PoseGoal | AnyGoal | None
    states: Array
    held: NDArray[np.intp]

    def held_at_start(self, states: Array) -> Array:
        """Return states, shape (N, dof), whose joints that stay are as at the start, bit for bit."""
        states = states.copy()
        states[:, self.held] = self.start[self.held]
        return states

    def refined(self, q: Array) -> Array | None:
        """Return the state near another one, shape (dof,), that reaches the goal, or None where there is none."""
        if self.goal is None:
            return next((one for one in self.states if np.abs(one - q).max() <= NEAR), None)
        for member in self.goal.nearest_members(q) if isinstance(self.goal, AnyGoal) else (self.goal,):
            near, free = self.start.copy(), member.inverse.free
            near[free] = q[free]  # joints that move none of the frames stay
            end: Array = member.inverse.descend(near, tolerance=TOLERANCE).states[0]
            if np.abs(end - q)[free].max(initial=0.0) <= NEAR and within(member.errors(end), member.bounds):
                kept: Array = self.held_at_start(end[None])[0]
                return kept
        return None


def task_goal(
    robot: Robot, world: TaskWorld, given: Problem, move: MoveStep, start: Array, *, group: Group | None = None
) -> TaskGoal:
    """Return the goal of a motion from a state, shape (dof,).

    Args:
        robot: The robot.
        world: The world.
        given: The problem that the task is part of.
        move: The motion.
        start: The state.
        group: Joints that are planned where the motion names none.

    Raises:
        ApexError: The goal is not possible.
    """
    problem = world.problem(given, move.goal, start)
    moving: Sequence[str] = robot.joint_names
    if move.group is not None or group is not None:
        moving = planned_joints(robot, move.group or group or ())
    held = np.array([k for k, name in enumerate(robot.joint_names) if name not in moving], np.intp)
    lower, upper = held_range(robot.limits.lower, robot.limits.upper, start, held)
    narrow = with_range(robot, lower, upper) if len(held) else robot
    states = robot.within_limits(problem.goal_states(robot.joint_names))
    states = states[[(q[held] == start[held]).all() for q in states]] if len(states) else states
    return TaskGoal(problem, narrow, start, workspace_goal(narrow, problem), states, held)
