"""Planning setup: robot, collision checker, state space, start and goals of a problem in one SimpleSetup."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING
from weakref import ref

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.tables import with_range
from apex_ompl.errors import ParameterError
from apex_ompl.goals.alignment import AlignmentGoal, alignment_goal
from apex_ompl.goals.any_goal import AnyGoal
from apex_ompl.goals.goal_sampling import sample, sample_on_constraints
from apex_ompl.goals.grasp_goal import pose_alternatives
from apex_ompl.goals.pose_goal import PoseGoal, pose_goals
from apex_ompl.ompl.constrained_space import constraint_of
from apex_ompl.ompl.simple_setup import SimpleSetup
from apex_ompl.ompl.space import Bounds, to_state
from apex_ompl.ompl.validity import ConstrainedMotionCheck, MotionCheck, MotionValidator, StateValidityChecker
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.model import TURN
from apex_ompl.scene.constraints import Constraint
from apex_ompl.scene.problem import Problem
from apex_ompl.scene.scripts import problem_at
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct
from apex_ompl.util.display import counted, one_line

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet
    from apex_ompl.constraints.user import UserConstraint

GOAL_STATES = 8  # how many states an alignment goal is sampled into
GOAL_ATTEMPTS = 200
TURNED_GOALS = 16  # most goals, among them those that differ by whole turns of continuous joints
SAME_ANGLE = 1e-9  # by which a joint that stays may be off after whole turns [rad]
HELD_WIDTH = 1e-9  # half width of the bounds of joints that stay, for splines that are evaluated with rounding [rad]


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
        goals: Goal states, shape (goals, dof); for one in the workspace those that were sampled.
        start_fault: Why the start is invalid, or empty.
        goal_faults: Why each goal is invalid, or empty; invalid ones are not given to OMPL unless all are. For a goal
            in the workspace that was not reached, why.
        alignment: The alignment goal, or None.
        held: Numbers of the joints that stay as at the start.
        constraints: Constraints along the path, or None where there are none.
        start_off: Which of them the start violates, and by how much, or empty.
        goals_off: Which of them each goal violates, or empty; those that do are not given to OMPL unless all do.
        further_constraints: Those that the problem does not list.
        seed: Seed of the sampling of goals, and of the plan.
        notes: Sentences on joints of the start and the goals that were moved to their limits, and on meshes that are no
            proper solids, and how they are interpreted.
    """

    problem: Problem
    robot: Robot
    checker: CollisionChecker
    check: MotionCheck
    simple_setup: SimpleSetup
    validity_checker: StateValidityChecker
    motion_validator: MotionValidator
    start: Array
    goals: Array
    start_fault: str
    goal_faults: tuple[str, ...]
    alignment: AlignmentGoal | None
    held: NDArray[np.intp]
    constraints: ConstraintSet | None
    start_off: str
    goals_off: tuple[str, ...]
    further_constraints: tuple[Constraint | UserConstraint, ...]
    seed: int
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        """Return the problem, the robot and the number of goals."""
        goals = counted(len(self.goals), "goal state")
        return one_line("PlanningSetup", repr(self.problem.name), f"robot {self.robot.name!r}", goals, self.start_fault)

    def raise_faults(self) -> None:
        """Raise the exception that the checkers kept inside of OMPL's callbacks, such as Ctrl-C."""
        constraint = constraint_of(self.simple_setup.getStateSpace())
        fault = self.validity_checker.fault or self.motion_validator.fault or (constraint and constraint.fault)
        if fault is not None:
            raise fault

    @property
    def bounds(self) -> Bounds:
        """Bounds of the state space."""
        return _bounds(self.robot, self.start, self.held)

    @property
    def valid_goals(self) -> Array:
        """The goals that are inside the limits, free and on the constraints, shape (valid, dof)."""
        faults = zip(self.goal_faults, self.goals_off, strict=False)
        return self.goals[[not fault and not off for fault, off in faults][: len(self.goals)]]


def assemble(
    problem: Problem, robot: Robot | None = None, seed: int = 0, checker: CollisionChecker | None = None,
    moving: Sequence[str] | None = None, *, constraints: Sequence[Constraint | UserConstraint] = (),
) -> PlanningSetup:  # fmt: skip
    """Make a problem ready for OMPL.

    Args:
        problem: The problem; moving obstacles stand where they are at time 0, if they are there then.
        robot: Its robot, when it is loaded already.
        seed: Seed of the sampling of an alignment goal.
        checker: Collision checker that has the bodies of the problem already.
        moving: Names of the joints that are planned; the others stay as at the start. All by default.
        constraints: Constraints along the path besides those of the problem.

    Raises:
        ApexError: The robot, a mesh or a joint of the problem is unknown or faulty.
    """
    robot = robot or load_robot(problem.robot)
    names = robot.joint_names
    held = np.array([k for k, name in enumerate(names) if moving is not None and name not in moving], np.intp)
    start, goals, notes = _ends(problem, robot, held)
    lower, upper = bounds = _bounds(robot, start, held)
    sampled = workspace_goal(with_range(robot, lower, upper) if len(held) else robot, problem)
    if checker is None:
        now = problem_at(problem, 0.0)
        checker = CollisionChecker(robot, now.scene, now.attached, now.allowed)
    checker.prepare()
    along = constraint_set(robot, problem, constraints, start, held)
    start_fault = state_fault(checker, start)
    goal_faults = tuple(_held_fault(robot, start, goal, held) or state_fault(checker, goal) for goal in goals)
    if sampled is not None and not start_fault:
        rng = np.random.default_rng(seed)
        sampling = sample(sampled, checker, rng, GOAL_STATES, GOAL_ATTEMPTS)
        if along is not None:
            sampling = sample_on_constraints(
                sampled, along, checker, rng, known=sampling, count=GOAL_STATES, max_attempts=GOAL_ATTEMPTS
            )
        goals = robot.turned_to(sampling.states, start)
        goals[:, held] = start[held]
        goal_faults = ("",) * len(goals) or (sampling.fault,)
    goals, goal_faults = _turned_goals(robot, start, goals, goal_faults, held)
    if along is not None:
        bounds = _bounds(robot, start, _resting(along, start, goals, held))
    simple_setup = SimpleSetup(robot, bounds, along)
    si = simple_setup.getSpaceInformation()
    check = MotionCheck(checker) if along is None else ConstrainedMotionCheck(checker, along)
    validity_checker = StateValidityChecker(si, checker, along)
    motion_validator = MotionValidator(si, check, validity_checker)
    simple_setup.setStateValidityChecker(validity_checker)
    si.setMotionValidator(motion_validator)
    constraint = constraint_of(si.getStateSpace())
    if constraint is not None:
        constraint.stop = _stop_of(motion_validator)
    simple_setup.setStartState(to_state(si, start))
    start_off, goals_off = "", ("",) * len(goals)
    if along is not None:
        start_off, goals_off = along.fault(start), tuple(along.fault(goal) for goal in goals)
        if start_off:
            along.check()
    given = [goal for goal, fault, off in zip(goals, goal_faults, goals_off, strict=False) if not fault and not off]
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
        sampled if isinstance(sampled, AlignmentGoal) else None,
        held,
        along,
        start_off,
        goals_off,
        tuple(constraints),
        seed,
        (*notes, *checker.mesh_notes),
    )


def constraint_set(
    robot: Robot, problem: Problem, constraints: Sequence[Constraint | UserConstraint], start: Array,
    held: NDArray[np.intp],
) -> ConstraintSet | None:  # fmt: skip
    """Return the constraints of a plan, or None where there are none.

    Args:
        robot: The robot.
        problem: The problem; an object that two links hold is a constraint, too.
        constraints: Further ones.
        start: The start, shape (dof,).
        held: Numbers of the joints that stay as at the start.

    Raises:
        ParameterError: ``constraints`` is no list.
        ApexError: A frame is unknown, or no planned joint moves it.
    """
    if not isinstance(constraints, (list, tuple)):
        raise ParameterError("constraints", constraints, "a list of constraints")
    if not (problem.constraints or constraints or any(one.links is not None for one in problem.attached)):
        return None
    from apex_ompl.constraints import paths  # noqa: F401 - which searches need: a fork waits for what is imported here
    from apex_ompl.constraints.constraint_set import ConstraintSet

    hands = (hand.synergy for hand in robot.hands.values() if hand.synergy is not None)
    fixed = sorted({*held.tolist(), *(robot.joint_names.index(name) for name in hands)})
    return ConstraintSet.of(robot, (*problem.constraints, *constraints), problem.attached, start, fixed)


def _ends(problem: Problem, robot: Robot, held: NDArray[np.intp]) -> tuple[Array, Array, list[str]]:
    """Return the start, shape (dof,), the goals nearest to it, shape (N, dof), and notes on joints that were moved.

    Joints a little outside their limits are moved to them, goals of continuous joints by whole turns.
    """
    asked, given_goals = problem.start_state(robot.joint_names), problem.goal_states(robot.joint_names)
    start, goals = robot.within_limits(asked), robot.within_limits(given_goals)
    notes = _moved_notes(robot, asked, start, "start")
    for k, (given_goal, goal) in enumerate(zip(given_goals, goals, strict=True)):
        notes += _moved_notes(robot, given_goal, goal, "goal" if len(goals) == 1 else f"goal {k}")
    goals = robot.turned_to(goals, start)
    stays = given_goals[:, held] == asked[held]
    stays |= robot.continuous[held] & np.isclose(goals[:, held], start[held], 0.0, SAME_ANGLE)
    goals[:, held] = np.where(stays, start[held], goals[:, held])  # where it is moved to
    return start, goals, notes


def _moved_notes(robot: Robot, asked: Array, moved: Array, what: str) -> list[str]:
    """Return a note on each joint of a start or a goal that was moved to its limit."""
    return [
        f"{robot.joint_names[k]} of the {what} is {abs(moved[k] - asked[k]):.2g} outside its limits and is moved to "
        f"{moved[k]:.6g}"
        for k in np.flatnonzero(moved != asked)
    ]


def _bounds(robot: Robot, start: Array, held: NDArray[np.intp]) -> Bounds:
    """Return the robot's limits, narrowed to the start for joints that stay, to a turn to either side if continuous."""
    lower, upper = robot.range_around(start, turns=1.0)
    return held_range(lower, upper, start, held)


def held_range(lower: Array, upper: Array, start: Array, held: NDArray[np.intp]) -> Bounds:
    """Return limits of joints, shape (dof,) each, narrowed to the start for joints that stay.

    A joint that is outside its limits at the start, which is a fault, has a narrow range at the limit.
    """
    at = start[held].clip(lower[held], upper[held])
    lower, upper = lower.copy(), upper.copy()
    lower[held], upper[held] = np.maximum(lower[held], at - HELD_WIDTH), np.minimum(upper[held], at + HELD_WIDTH)
    return lower, upper


def _turned_goals(
    robot: Robot, start: Array, goals: Array, faults: tuple[str, ...], held: NDArray[np.intp]
) -> tuple[Array, tuple[str, ...]]:
    """Return goals, shape (N, dof), and the same after whole turns of continuous joints, with the fault of each.

    The given ones, which are the nearest to the start, come first; then others at most a turn from it, the nearest
    first, up to TURNED_GOALS in all.
    """
    free = np.flatnonzero(robot.continuous & ~np.isin(np.arange(robot.dof), held))
    room = TURNED_GOALS - len(goals)
    if not len(free) or not len(goals) or room <= 0:
        return goals, faults
    low, high = _bounds(robot, start, held)
    turned = [
        (float(np.linalg.norm(q - start)), k, q)
        for k, goal in enumerate(goals)
        for q in _by_one_turn(goal, free)
        if ((q >= low) & (q <= high)).all()
    ]
    turned.sort(key=lambda one: one[:2])
    more = turned[:room]
    return np.concatenate([goals, *(q[None] for _, _, q in more)]), (*faults, *(faults[k] for _, k, _ in more))


def _by_one_turn(goal: Array, joints: NDArray[np.intp]) -> list[Array]:
    """Return a state, shape (dof,), with one or two of some joints a turn further or less."""
    found = []
    for some in (*combinations(joints, 1), *combinations(joints, 2)):
        for turns in product((-TURN, TURN), repeat=len(some)):
            q = goal.copy()
            q[list(some)] += turns
            found.append(q)
    return found


def _stop_of(validator: MotionValidator) -> Callable[[], bool]:
    """Return a function that asks a motion validator whether motions are to be invalid, without owning it."""
    known = ref(validator)

    def stop() -> bool:
        one = known()
        return one is not None and one.stop()

    return stop


def _resting(constraints: ConstraintSet, start: Array, goals: Array, held: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the joints that stay: those that are held, and those out of reach of projection that no goal moves."""
    alike = [k for k in constraints.fixed if (goals[:, k] == start[k]).all()]
    return distinct(np.append(held, np.array(alike, np.intp)))


def _held_fault(robot: Robot, start: Array, goal: Array, held: NDArray[np.intp]) -> str:
    """Return why a goal is out of reach of the joints that are planned, or nothing."""
    for k in held:
        if goal[k] != start[k]:
            name = robot.joint_names[k]
            return f"{name} = {goal[k]:.6g} at the goal, which is not in the group and stays at {start[k]:.6g}"
    return ""


def workspace_goal(robot: Robot, problem: Problem) -> AlignmentGoal | PoseGoal | AnyGoal | None:
    """Return the goal of a problem that is sampled, or None where it is joint configurations.

    Raises:
        UnknownNameError: A held object, a link or a hand is unknown.
        FileFormatError: An alignment does not fit the held objects.
    """
    start = problem.start_state(robot.joint_names)
    if problem.goal.poses is not None:
        poses = pose_goals(robot, problem.goal.poses, problem.attached, start)
        return poses[0] if len(poses) == 1 else AnyGoal(robot, poses, np.empty((0, robot.dof)), start)
    if problem.goal.grasp is not None or problem.goal.all_of is not None:
        alternatives = pose_alternatives(robot, problem, problem.goal)
        grasps = [one for poses in alternatives for one in pose_goals(robot, poses, problem.attached, start)]
        return AnyGoal(robot, grasps, np.empty((0, robot.dof)), start)
    if problem.goal.any_of is None:
        return alignment_goal(robot, problem)
    members, states = list[PoseGoal | AlignmentGoal](), [np.empty((0, robot.dof))]
    for goal in problem.goal.any_of:
        one = problem.model_copy(update={"goal": goal})
        found = workspace_goal(robot, one)
        if isinstance(found, AnyGoal):
            members += found.members
        elif found is None:
            states.append(robot.turned_to(robot.within_limits(one.goal_states(robot.joint_names)), start))
        else:
            members.append(found)
    return AnyGoal(robot, members, np.concatenate(states), start)


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
