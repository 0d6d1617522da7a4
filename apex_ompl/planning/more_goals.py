"""More goals of a plan: states of a goal in the workspace that are drawn beside those that the set-up found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from apex_ompl.collision.tables import with_range
from apex_ompl.goals.goal_sampling import GoalSet, WorkspaceGoal, sample
from apex_ompl.ompl.setup import GOAL_ATTEMPTS, GOAL_STATES, PlanningSetup, workspace_goal
from apex_ompl.types import Array


def sampled_goal(setup: PlanningSetup) -> WorkspaceGoal | GoalSet | None:
    """Return the goal of a problem that is given in the workspace, for the joints that are planned, or None."""
    robot = setup.robot
    if len(setup.held):
        robot = with_range(robot, *setup.bounds)
    return workspace_goal(robot, setup.problem)


def with_more(
    setup: PlanningSetup, goal: WorkspaceGoal | GoalSet, rng: np.random.Generator
) -> tuple[PlanningSetup, Array]:
    """Return a set-up with the valid goals that it has and more of them, and the new ones, shape (N, dof)."""
    found = sample(goal, setup.checker, rng, GOAL_STATES, GOAL_ATTEMPTS).states
    found[:, setup.held] = setup.start[setup.held]
    goals = np.concatenate([setup.valid_goals, found])
    none = ("",) * len(goals)
    return replace(setup, goals=goals, goal_faults=none, goals_off=none), found
