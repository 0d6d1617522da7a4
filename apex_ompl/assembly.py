"""From a problem to OMPL: robot, verdict, space, checkers, start and goals in one SimpleSetup."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.collision import Verdict
from apex_ompl.goals import AlignmentGoal, alignment_goal
from apex_ompl.problem import Problem
from apex_ompl.resolution import SEARCH_RESOLUTION
from apex_ompl.robot import Robot, load_robot
from apex_ompl.space import state_space, to_state
from apex_ompl.validity import MotionCheck, VerdictChecker, VerdictMotionValidator

Array = NDArray[np.float64]

GOAL_STATES = 8  # how many states an alignment goal is sampled into
GOAL_ATTEMPTS = 200


@dataclass(frozen=True, eq=False)
class PlanningSetup:
    """A problem made ready for OMPL.

    Attributes:
        problem: The problem.
        robot: Its robot.
        verdict: Judges states.
        check: Judges motions at the search resolution.
        simple_setup: OMPL's setup, with start and goals set and no planner chosen.
        checker: OMPL's state validity checker.
        motions: OMPL's motion validator.
        start: Start state, shape (dof,).
        goals: Goal states, shape (goals, dof); for an alignment those that were sampled.
        start_fault: Why the start is invalid, or empty.
        goal_faults: Why each goal is invalid, or empty; invalid ones are not given to OMPL unless all are. For an
            alignment that was not reached, why.
        alignment: The alignment goal, or None.
    """

    problem: Problem
    robot: Robot
    verdict: Verdict
    check: MotionCheck
    simple_setup: og.SimpleSetup
    checker: VerdictChecker
    motions: VerdictMotionValidator
    start: Array
    goals: Array
    start_fault: str
    goal_faults: tuple[str, ...]
    alignment: AlignmentGoal | None

    @property
    def valid_goals(self) -> Array:
        """The goals that are inside the limits and free, shape (valid, dof)."""
        return self.goals[[not fault for fault in self.goal_faults[: len(self.goals)]]]


def assemble(problem: Problem, robot: Robot | None = None, seed: int = 0) -> PlanningSetup:
    """Make a problem ready for OMPL.

    Args:
        problem: The problem; moving obstacles stand where they are at time 0.
        robot: Its robot, when it is loaded already.
        seed: Seed of the sampling of an alignment goal.

    Raises:
        ApexError: The robot, a mesh or a joint of the problem is unknown or faulty.
    """
    robot = robot or load_robot(problem.robot)
    start = problem.start_state(robot.joint_names)
    goals = problem.goal_states(robot.joint_names)
    alignment = alignment_goal(robot, problem)
    verdict = Verdict(robot, problem.scene, problem.attached)
    verdict.prepare()
    start_fault = state_fault(verdict, start)
    goal_faults = tuple(state_fault(verdict, goal) for goal in goals)
    if alignment is not None and not start_fault:
        sampling = alignment.sample(verdict, np.random.default_rng(seed), GOAL_STATES, GOAL_ATTEMPTS)
        goals = sampling.states
        goal_faults = ("",) * len(goals) or (sampling.fault,)
    space = state_space(robot)
    simple_setup = og.SimpleSetup(space)
    si = simple_setup.getSpaceInformation()
    check = MotionCheck(verdict, SEARCH_RESOLUTION)
    checker, motions = VerdictChecker(si, verdict), VerdictMotionValidator(si, check)
    simple_setup.setStateValidityChecker(checker)
    si.setMotionValidator(motions)
    si.setStateValidityCheckingResolution(SEARCH_RESOLUTION / space.getMaximumExtent())
    simple_setup.setStartState(to_state(si, start))
    given = [goal for goal, fault in zip(goals, goal_faults, strict=False) if not fault]
    set_goals(simple_setup, given or list(goals))
    return PlanningSetup(
        problem,
        robot,
        verdict,
        check,
        simple_setup,
        checker,
        motions,
        start,
        goals,
        start_fault,
        goal_faults,
        alignment,
    )


def set_goals(simple_setup: og.SimpleSetup, goals: list[Array]) -> None:
    """Give OMPL one goal state, or several of which any will do; each is a state of shape (dof,)."""
    si = simple_setup.getSpaceInformation()
    if len(goals) == 1:
        simple_setup.setGoalState(to_state(si, goals[0]))
        return
    region = ob.GoalStates(si)
    for goal in goals:
        region.addState(to_state(si, goal))
    simple_setup.setGoal(region)


def state_fault(verdict: Verdict, q: Array) -> str:
    """Return why a state is invalid: the first joint out of limits, or the deepest contact; else nothing."""
    fault = verdict.robot.limit_fault(q)
    if fault:
        return fault
    if verdict.is_free(q):
        return ""
    contacts = verdict.contacts(q)
    return str(contacts[0]) if contacts else "in collision"
