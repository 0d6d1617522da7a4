"""Starts and goals of a problem definition, and the pairs of them that are planned between."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl.ompl_adapter.space import to_array
from apex_ompl.types import Array

MAX_GOALS, GOAL_ATTEMPTS = 8, 32  # goals that are read, and samples that are drawn for them
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


def read_goals(inputs: Any, dof: int, ptc: ob.PlannerTerminationCondition) -> list[Array]:
    """Return valid goal states, each of shape (dof,), a few where the goal is a region.

    Args:
        inputs: The planner's ``getPlannerInputStates()``.
        dof: Number of joints.
        ptc: Ends the sampling of a region.
    """
    found = []
    state = inputs.nextGoal(ptc)  # waits for one
    for _ in range(GOAL_ATTEMPTS):
        if state is not None:
            found.append(to_array(state, dof))
        if len(found) == MAX_GOALS or ptc() or not inputs.haveMoreGoalStates():
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
