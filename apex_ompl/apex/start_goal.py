"""Starts and goals of a problem definition, and the pairs of them that are planned between."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl.ompl.space import await_goal, to_array
from apex_ompl.types import Array

MAX_GOALS, GOAL_ATTEMPTS = 8, 32  # goals that are read of a region, and samples that are drawn for them
MAX_STATES = 256  # states of a goal that has no more, all of which are read
MAX_PAIRS = 8  # pairs of start and goal that proposals are made for


def read_starts(inputs: Any, dof: int) -> list[Array]:
    """Return the valid start states, each of shape (dof,).

    Args:
        inputs: The planner's ``getPlannerInputStates()``.
        dof: Number of joints.
    """
    found = []
    inputs.restart()
    while inputs.haveMoreStartStates():
        state = inputs.nextStart()
        if state is None:
            break
        found.append(to_array(state, dof))
    return _distinct(found)


def read_goals(inputs: Any, dof: int, ptc: ob.PlannerTerminationCondition, goal: Any) -> list[Array]:
    """Return the valid goal states, each of shape (dof,), or a few where there are many, or the goal is a region.

    Args:
        inputs: The planner's ``getPlannerInputStates()``.
        dof: Number of joints.
        ptc: Ends the sampling of a region.
        goal: The goal.
    """
    found = []
    sampled = goal is not None and goal.hasType(ob.GOAL_SAMPLEABLE_REGION)
    count = goal.maxSampleCount() if sampled else 0
    most, attempts = (count, count) if MAX_GOALS < count <= MAX_STATES else (MAX_GOALS, GOAL_ATTEMPTS)
    await_goal(goal, ptc)
    state = inputs.nextGoal(ptc)
    for _ in range(attempts):
        if state is not None:
            found.append(to_array(state, dof))
        if len(found) == most or ptc() or not inputs.haveMoreGoalStates():
            break
        state = inputs.nextGoal()  # None where the next sample is invalid
    return _distinct(found)


def nearest_pairs(starts: list[Array], goals: list[Array]) -> list[tuple[Array, Array]]:
    """Return the pairs of start and goal that are nearest to each other, the nearest first."""
    pairs = product(starts, goals)
    return sorted(pairs, key=lambda pair: float(np.linalg.norm(pair[1] - pair[0])))[:MAX_PAIRS]


def _distinct(states: list[Array]) -> list[Array]:
    """Return the finite states, each once."""
    found: list[Array] = []
    for state in states:
        if np.isfinite(state).all() and not any(np.array_equal(state, other) for other in found):
            found.append(state)
    return found
