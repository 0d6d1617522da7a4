"""Planning setup: robot, collision checker, state space, start and goals of a problem in one SimpleSetup."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import mesh_note
from apex_ompl.ompl_adapter.space import state_space, to_state
from apex_ompl.ompl_adapter.validity import MotionCheck, MotionValidator, StateValidityChecker
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.problem import Problem
from apex_ompl.tasks.alignment import AlignmentGoal, alignment_goal
from apex_ompl.types import Array
from apex_ompl.util.resolution import SEARCH_RESOLUTION

GOAL_STATES = 8  # how many states an alignment goal is sampled into
GOAL_ATTEMPTS = 200


@dataclass(frozen=True, eq=False)
class PlanningSetup:
    """A problem made ready for OMPL.

    Attributes:
        problem: The problem.
        robot: Its robot.
        checker: Collision checker of the robot in the scene.
        check: Check of straight motions at the search resolution.
        simple_setup: OMPL's setup, with start and goals set and no planner chosen.
        validity_checker: OMPL's state validity checker.
        motion_validator: OMPL's motion validator.
        start: Start state, shape (dof,).
        goals: Goal states, shape (goals, dof); for an alignment those that were sampled.
        start_fault: Why the start is invalid, or empty.
        goal_faults: Why each goal is invalid, or empty; invalid ones are not given to OMPL unless all are. For an
            alignment that was not reached, why.
        alignment: The alignment goal, or None.
        notes: Sentences on meshes that are no proper solids as they are, and how they are taken.
    """

    problem: Problem
    robot: Robot
    checker: CollisionChecker
    check: MotionCheck
    simple_setup: og.SimpleSetup
    validity_checker: StateValidityChecker
    motion_validator: MotionValidator
    start: Array
    goals: Array
    start_fault: str
    goal_faults: tuple[str, ...]
    alignment: AlignmentGoal | None
    notes: tuple[str, ...]

    def raise_faults(self) -> None:
        """Raise what the checkers kept inside of OMPL's callbacks, Ctrl-C among it."""
        fault = self.validity_checker.fault or self.motion_validator.fault
        if fault is not None:
            raise fault

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
    checker = CollisionChecker(robot, problem.scene, problem.attached)
    checker.prepare()
    start_fault = state_fault(checker, start)
    goal_faults = tuple(state_fault(checker, goal) for goal in goals)
    if alignment is not None and not start_fault:
        sampling = alignment.sample(checker, np.random.default_rng(seed), GOAL_STATES, GOAL_ATTEMPTS)
        goals = sampling.states
        goal_faults = ("",) * len(goals) or (sampling.fault,)
    space = state_space(robot)
    simple_setup = og.SimpleSetup(space)
    si = simple_setup.getSpaceInformation()
    check = MotionCheck(checker, SEARCH_RESOLUTION)
    validity_checker, motion_validator = StateValidityChecker(si, checker), MotionValidator(si, check)
    simple_setup.setStateValidityChecker(validity_checker)
    si.setMotionValidator(motion_validator)
    si.setStateValidityCheckingResolution(SEARCH_RESOLUTION / space.getMaximumExtent())
    simple_setup.setStartState(to_state(si, start))
    given = [goal for goal, fault in zip(goals, goal_faults, strict=False) if not fault]
    set_goals(simple_setup, given or list(goals))
    return PlanningSetup(
        problem,
        robot,
        checker,
        check,
        simple_setup,
        validity_checker,
        motion_validator,
        start,
        goals,
        start_fault,
        goal_faults,
        alignment,
        tuple(filter(None, map(mesh_note, (*problem.scene, *problem.attached)))),
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


def state_fault(checker: CollisionChecker, q: Array) -> str:
    """Return why a state is invalid: the first joint out of limits, or the deepest contact; else nothing.

    A pair that is nearer than the proof of paths takes for contact is a fault too: no path could leave the state.
    """
    fault = checker.robot.limit_fault(q)
    if fault:
        return fault
    return checker.prove(q[None], tolerance=0.0).reason
