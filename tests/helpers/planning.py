"""Problems, checkers and paths, for the tests of planners inside OMPL."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl import problems
from apex_ompl.ompl.setup import PlanningSetup
from apex_ompl.ompl.space import path_to_array
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Problem

EXACT, TIMEOUT = ob.PlannerStatus.EXACT_SOLUTION, ob.PlannerStatus.TIMEOUT
HARD = "shelf/hard/800012"
EASY = "posts/easy/800001"


def within(seconds: float) -> ob.PlannerTerminationCondition:
    return ob.timedPlannerTerminationCondition(seconds)


@cache
def cached_problem(name: str) -> Problem:
    """The problem of a name, loaded once."""
    return problems.load(name)


def states(setup: og.SimpleSetup) -> np.ndarray:
    return path_to_array(setup.getSolutionPath(), robot().dof)


def solved(setup: PlanningSetup, planner: ob.Planner, seconds: float = 20.0) -> np.ndarray | None:
    """The path that a planner finds, solving alone and not anew, or None."""
    pdef = setup.simple_setup.getProblemDefinition()
    pdef.clearSolutionPaths()
    planner.setProblemDefinition(pdef)
    status = planner.solve(within(seconds)).getStatus()
    setup.raise_faults()
    return path_to_array(pdef.getSolutionPath(), setup.robot.dof) if status == EXACT else None


# Parameters of apex that turn its other stages off.
DIFFUSION_ONLY = {"bridge": False, "fallback": False, "polish": False}


class UserValidityChecker(ob.StateValidityChecker):
    """A validity checker as a user writes one: OMPL calls a function of the state, without proofs or batches."""

    def __init__(self, si: ob.SpaceInformation, free: Callable[[np.ndarray], bool]) -> None:
        super().__init__(si)
        self.free = free

    def isValid(self, state: Any) -> bool:  # noqa: N802
        return self.free(np.array(state[0:16]))
