"""Plans of whole tasks: a goal from which the steps after it can be done, a motion there, and these steps.

Goals are examined first, the nearest first: from each, the steps after the goal are planned without timing. The planner
then plans to those from which all of them can be done. So a goal whose continuation fails is never chosen, and the
reasons for which goals were rejected are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from math import isnan, nan
from typing import NamedTuple

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.ompl.process import Interrupt, quiet_ompl
from apex_ompl.ompl.setup import GOAL_ATTEMPTS, GOAL_STATES, PlanningSetup, workspace_goal
from apex_ompl.ompl.validity import full_check
from apex_ompl.planning.options import PlanOptions
from apex_ompl.planning.steps import assemble, query_fault
from apex_ompl.planning.task_result import GOAL, TaskResult, TaskStep
from apex_ompl.planning.task_steps import StepFailed, StepPlan, StepPlanner
from apex_ompl.planning.task_world import TaskWorld, check_steps
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.model import digest
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.problem import AnyStep, Goal, MoveStep, Problem
from apex_ompl.scene.steps import GraspStep, ReleaseStep, RetreatStep
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.trajectory import joined
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.forking import unforked
from apex_ompl.util.process import running

WANTED = 3  # goals from which all steps can be done, among which the planner chooses
EXAMINATION = 0.5  # of the time, at most, for the search for these goals once one is found
PER_GOAL = 0.5  # of the timeout, for the steps from one goal
ROUNDS = 7  # of sampling goals, after those of the set-up
MOST_CAUSES = 3  # that a reason names
WORDS = "no goal was found from which the steps after it can be done"

PlanTo = Callable[[Problem, float, bool], PlanResult]
"""Plans a problem in a time [s]; with True the first motion of the task, which alone has constraints along it."""


class Stage(NamedTuple):
    """A motion to a goal, and the steps after it up to the next such motion.

    Attributes:
        move: The motion; its goal is that of the problem for the first one.
        steps: The steps.
    """

    move: MoveStep
    steps: tuple[AnyStep, ...]


def stages(problem: Problem) -> list[Stage]:
    """Return the stages of a task."""
    found = [Stage(MoveStep(goal=problem.goal), ())]
    for step in problem.after:
        if isinstance(step, MoveStep):
            found.append(Stage(step, ()))
        else:
            found[-1] = found[-1]._replace(steps=(*found[-1].steps, step))
    return found


def plan_task(checker: CollisionChecker, problem: Problem, options: PlanOptions, plan_to: PlanTo) -> TaskResult:
    """Return the plan of a whole task: what :meth:`apex_ompl.MotionPlanner.plan_task` returns.

    Args:
        checker: Collision checker with the bodies of the problem, which it has again at the end.
        problem: The problem.
        options: The options of the plan.
        plan_to: Plans from goal to goal.

    Raises:
        ApexError: The problem, a step or an option is faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    options.check()
    check_steps(checker.robot, problem)
    task = TaskPlanner(checker, problem, options, plan_to)
    try:
        return task.plan()
    finally:
        checker.become(task.world.scene, task.world.held, task.world.pairs)


class TaskPlanner:
    """Plans one task.

    Attributes:
        world: The world on the way to the goal.
        rejected: Why steps after a goal could not be done -> number of goals.
        examined: Number of goals from which the steps were tried.
    """

    def __init__(
        self, checker: CollisionChecker, problem: Problem, options: PlanOptions, plan_to: PlanTo
    ) -> None:  # fmt: skip
        """Plan the task of a problem; see :func:`plan_task`."""
        self._checker, self._problem, self._options, self._plan_to = checker, problem, options, plan_to
        self._timing = Timing() if options.timing is True else options.timing or None
        self._deadline, self._interrupt = Deadline(options.timeout), Interrupt()
        self._stages, self._times = stages(problem), {"steps": 0.0}
        self.world = TaskWorld.of(checker.robot, problem)
        self.rejected, self.examined = Counter[str](), 0
        bodies = self.world.scene.values(), self.world.held.values(), self.world.allowed
        mine = CollisionChecker(checker.robot, *bodies)
        self._steps = StepPlanner(mine, problem, self._deadline, lambda: self._interrupt.pressed)

    def plan(self) -> TaskResult:
        """Return the plan of the whole task."""
        given = self._options
        setup = assemble(
            self._problem, self._checker.robot, seed=given.seed, group=given.group, checker=self._checker,
            constraints=given.constraints,
        )  # fmt: skip
        self._deadline.restart(given.timeout)
        fault = query_fault(setup)[0]
        leaves = given.leave_contact and setup.start_fault
        if fault is not None and not leaves:
            return TaskResult.of(self._plan_to(self._problem, given.timeout, True))
        try:
            found, plans = self._solved(0, self.world, setup)
        except NotPlannedError as failure:
            return self._said(TaskResult.of(failure.result))
        except StepFailed as failure:
            return self._failed(str(failure))
        return self._said(_whole(found, plans, self._checker.robot, self._problem))

    def _solved(self, k: int, world: TaskWorld, setup: PlanningSetup) -> tuple[PlanResult, list[StepPlan]]:
        """Return the plan to the goal of a stage, and those of all steps after it.

        Args:
            k: Number of the stage.
            world: The world at its start.
            setup: The problem of its motion.

        Raises:
            NotPlannedError: The planner found no motion to the goal of the first stage.
            StepFailed: It, or one after it, cannot be done.
        """
        stage = self._stages[k]
        with self._interruptible():
            goals = self._goals(setup, world, stage.steps)
        while goals:
            time = self._deadline.for_search
            if time <= 0.0:
                break
            self._checker.become(world.scene, world.held, world.pairs)
            found = self._plan_to(self._to(setup.problem, goals), time, k == 0)
            if not found or found.path is None:
                if k == 0:
                    raise NotPlannedError(found)
                raise StepFailed(f"{stage.move.title}: {found.reason}", f"{stage.move.title}: {found.status}")
            reached = found.path.states[-1]
            try:
                with self._interruptible():
                    plans = self._steps.follow(stage.steps, world, reached, self._timing, self._deadline)
                return found, plans + self._further(k + 1, plans[-1].after if plans else world, _end(plans, reached))
            except StepFailed as failure:
                self.rejected[failure.cause] += 1
                goals = [goal for goal in goals if not np.array_equal(goal, reached)]
        raise StepFailed(WORDS)

    def _further(self, k: int, world: TaskWorld, q: Array) -> list[StepPlan]:
        """Return the plans of a stage and those after it, from a state, shape (dof,); none after the last one.

        Raises:
            StepFailed: One cannot be done.
        """
        if k == len(self._stages):
            return []
        move = self._stages[k].move
        problem = world.problem(self._problem, move.goal, q)
        self._checker.become(world.scene, world.held, world.pairs)
        with unforked(), quiet_ompl(), self._deadline.paused():
            setup = assemble(problem, self._checker.robot, seed=self._options.seed, checker=self._checker)
        status, reason, _ = query_fault(setup)
        if status is not None:
            raise StepFailed(f"{move.title}: {reason}", f"{move.title}: {status}")
        found, plans = self._solved(k, world, setup)
        assert found.path is not None
        clearance = found.clearance if found.trajectory is None else found.motion_clearance
        deviation = 0.0 if found.trajectory is None else found.deviation
        plan = StepPlan(
            move, world, world, found.path, found.trajectory, clearance, use=found.limit_use, deviation=deviation
        )
        return [plan, *plans]

    def _goals(self, setup: PlanningSetup, world: TaskWorld, steps: Sequence[AnyStep]) -> list[Array]:
        """Return goals from which steps can be done, the nearest first: a few, or all where there is no step."""
        if not steps:
            return list(setup.valid_goals)
        found, timeout = list[Array](), self._deadline.timeout
        until = self._deadline.remaining * (1.0 - EXAMINATION)
        for goal in self._candidates(setup):
            late = self._deadline.remaining <= until
            if self._interrupt.pressed or self._deadline.for_search <= 0.0 or (found and late):
                break
            self.examined += 1
            try:
                time = min(PER_GOAL * timeout, self._deadline.remaining)
                self._steps.follow(steps, world, goal, None, Deadline(time))
            except StepFailed as failure:
                self.rejected[failure.cause] += 1
                continue
            found.append(goal)
            if len(found) == WANTED:
                break
        return found

    def _candidates(self, setup: PlanningSetup) -> Iterator[Array]:
        """Yield goals, the nearest first; then others that are sampled, where the goal is in the workspace."""
        robot, goals = setup.robot, setup.valid_goals
        yield from goals[np.argsort(direct_durations(setup.start, goals, robot.limits), kind="stable")]
        goal = workspace_goal(robot, setup.problem)
        if goal is None or setup.constraints is not None or len(setup.held):
            return
        rng = np.random.default_rng([setup.seed, 1])
        for _ in range(ROUNDS):
            yield from sample(goal, setup.checker, rng, GOAL_STATES, GOAL_ATTEMPTS).states

    def _to(self, problem: Problem, goals: list[Array]) -> Problem:
        """Return a problem with goal states in place of its goal."""
        names = self._checker.robot.joint_names
        states = tuple(dict(zip(names, goal.tolist(), strict=True)) for goal in goals)
        return problem.model_copy(update={"goal": Goal(joints=states), "after": ()})

    def _said(self, result: TaskResult) -> TaskResult:
        """Return a result of the given problem, with the goals that were examined."""
        steps = self._times["steps"]
        times = {**result.times, "steps": steps, "total": result.times.get("total", 0.0) + steps}
        return replace(
            result, problem=self._problem, times=times, goals_examined=self.examined,
            goals_rejected=dict(self.rejected), checks=result.checks + self._steps.checker.check_counts.states,
        )  # fmt: skip

    def _failed(self, reason: str) -> TaskResult:
        """Return the result of a task whose steps cannot be done."""
        counts = self.rejected.most_common(MOST_CAUSES)
        causes = "; ".join(f"{cause} ({n} of {self.examined} goals)" for cause, n in counts)
        robot, status = self._checker.robot, PlanStatus.STEP_FAILED
        if self._deadline.for_search <= 0.0:
            reason, status = f"the task was not planned in {self._options.timeout:g} s", PlanStatus.TIMEOUT
        made = TaskResult(
            status=status, reason="; ".join(filter(None, [reason, causes])), problem=self._problem, robot=robot.name,
            joint_names=robot.joint_names, planner="task", seed=self._options.seed, robot_digest=digest(robot),
        )  # fmt: skip
        return self._said(made)

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """While the block runs, hold Ctrl-C back, and measure the time."""
        with Interrupt() as self._interrupt, running(self._interrupt.end), timed(self._times, "steps"), quiet_ompl():
            yield


class NotPlannedError(Exception):
    """The planner found no motion to the goal of a problem.

    Attributes:
        result: What it returned.
    """

    def __init__(self, result: PlanResult) -> None:
        """Keep the result."""
        super().__init__(result.reason)
        self.result = result


def _end(plans: Sequence[StepPlan], q: Array) -> Array:
    """Return the state after steps, or the one before them, shape (dof,), where there are none."""
    return plans[-1].end if plans else q


def task_fault(result: TaskResult, motion: Trajectory) -> str:
    """Return why a motion with the times of a task's steps is not free in the scenes of these, or an empty text.

    Args:
        result: The task.
        motion: A motion such as its own, or that at another rate.
    """
    robot = load_robot(result.problem.robot)
    for step in result.steps:
        checker = CollisionChecker(robot, step.scene, step.attached, step.allowed)
        check = full_check(checker, _between(motion, step.start, step.end))
        if check and not isnan(step.left):
            for pair in step.leaving:
                checker.allow(*pair, allowed=False)
            check = full_check(checker, _between(motion, step.left, step.end))
        if not check:
            return f"{step.title}: {check.reason}"
    return ""


def _between(motion: Trajectory, start: float, end: float) -> Trajectory:
    """Return the part of a motion between two times [s]."""
    return motion.before(end).after(start)


def _whole(found: PlanResult, plans: list[StepPlan], robot: Robot, problem: Problem) -> TaskResult:
    """Return the result of a task from the plan to its goal and the plans of the steps after it."""
    motion, path = found.trajectory, found.path
    assert path is not None
    start, time = (nan, nan) if motion is None else (0.0, motion.duration)
    clearance = found.clearance if motion is None else found.motion_clearance
    bodies = problem.scene, problem.attached, problem.allowed
    steps = [TaskStep(GOAL, GOAL, start, time, path, clearance, *bodies)]
    for plan in plans:
        end = nan if plan.motion is None else time + plan.motion.duration
        left = plan.left if plan.motion is None else time + plan.left
        steps.append(_step(plan, time, end, left))
        time = end
    result = replace(TaskResult.of(found), steps=tuple(steps))
    if motion is None:
        return result
    whole = joined([motion, *(plan.motion for plan in plans if plan.motion is not None)])
    uses = [found.limit_use, *(plan.use for plan in plans)]
    use = {name: max(one.get(name, 0.0) for one in uses) for name in dict.fromkeys(n for one in uses for n in one)}
    return replace(
        result, trajectory=whole, limit_use=use | dict(whole.use(robot.limits)),
        motion_clearance=min(step.clearance for step in steps),
        deviation=max([found.deviation, *(plan.deviation for plan in plans)]),
    )  # fmt: skip


def _step(plan: StepPlan, start: float, end: float, left: float) -> TaskStep:
    """Return the record of a step that was planned."""
    step, world, after = plan.step, plan.world, plan.after
    released, grasped = tuple[str, ...](), tuple[str, ...]()
    if isinstance(step, ReleaseStep):
        released = step.objects or world.held_by(step.hand)
    elif isinstance(step, GraspStep):
        grasped = (step.object,)
    leaving = world.leaving_pairs(step.hand) if isinstance(step, RetreatStep) else ()
    gone = tuple(name for name in released if name not in after.scene and name not in after.held)
    return TaskStep(
        step.kind, step.title, start, end, plan.path, plan.clearance, tuple(world.scene.values()),
        tuple(world.held.values()), tuple(sorted(world.pairs)), left, tuple(sorted(leaving)), released, grasped, gone,
    )  # fmt: skip
