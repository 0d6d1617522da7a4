"""Plans of whole tasks: a goal from which the steps after it can be done, a motion there, and these steps.

Goals are examined first, the nearest first: from each, the steps after the goal are planned without timing. The planner
then plans to those from which all of them can be done. So a goal whose continuation fails is never chosen, and the
reasons for which goals were rejected are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import nan

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.ompl.setup import GOAL_ATTEMPTS, GOAL_STATES, PlanningSetup, workspace_goal
from apex_ompl.ompl.process import Interrupt, quiet_ompl
from apex_ompl.planning.planner import PlanOptions
from apex_ompl.planning.steps import assemble, query_fault
from apex_ompl.planning.task_result import GOAL, TaskResult, TaskStep
from apex_ompl.planning.task_steps import StepFailed, StepPlan, StepPlanner
from apex_ompl.planning.task_world import TaskWorld, check_steps
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot import Robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.scene.steps import GraspStep, ReleaseStep
from apex_ompl.timing import Timing
from apex_ompl.timing.trajectory import joined
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.process import running

WANTED = 3  # goals from which all steps can be done, among which the planner chooses
EXAMINATION = 0.5  # of the time, at most, for the search for these goals once one is found
ROUNDS = 50  # of sampling goals
LEAST_TIME = 1e-3  # of a plan [s]
WORDS = "no goal was found from which the steps after it can be done"

PlanTo = Callable[[Problem, float], PlanResult]
"""Plans a problem in a time [s]."""


def plan_task(checker: CollisionChecker, problem: Problem, options: PlanOptions, plan_to: PlanTo) -> TaskResult:
    """Return the plan of a whole task: what :meth:`apex_ompl.MotionPlanner.plan_task` returns.

    Args:
        checker: Collision checker with the bodies of the problem.
        problem: The problem.
        options: The options of the plan.
        plan_to: Plans the same problem to other goals.

    Raises:
        ApexError: The problem, a step or an option is faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    options.check()
    check_steps(checker.robot, problem)
    deadline = Deadline(options.timeout)
    setup = assemble(
        problem, checker.robot, seed=options.seed, group=options.group, checker=checker, constraints=options.constraints
    )
    start_fault = setup.start_fault and not options.leave_contact
    if start_fault or setup.start_off or (query_fault(setup)[0] is not None and not setup.start_fault):
        return TaskResult.of(plan_to(problem, options.timeout))
    timing = Timing() if options.timing is True else options.timing or None
    return TaskPlanner(setup, timing, deadline).plan(plan_to)


class TaskPlanner:
    """Plans one task.

    Attributes:
        rejected: Why steps after a goal could not be done -> number of goals.
        examined: Number of goals from which the steps were tried.
    """

    def __init__(self, setup: PlanningSetup, timing: Timing | None, deadline: Deadline) -> None:
        """Plan the task of a problem.

        Args:
            setup: The problem; its start and a goal are valid.
            timing: How motions are timed, or None for paths alone.
            deadline: When the plan is to be ready.
        """
        self.setup, self.timing, self.deadline = setup, timing, deadline
        self.problem, self.robot = setup.problem, setup.robot
        self.world = TaskWorld.of(self.robot, self.problem)
        bodies = self.world.scene.values(), self.world.held.values(), self.world.allowed
        self.steps = StepPlanner(CollisionChecker(self.robot, *bodies), self.problem, deadline, self._ends)
        self.rejected, self.examined = Counter[str](), 0
        self._times: dict[str, float] = {"steps": 0.0}
        self._interrupt = Interrupt()

    def plan(self, plan_to: PlanTo) -> TaskResult:
        """Return the plan of the whole task.

        Args:
            plan_to: Plans to goal states.
        """
        with self._interruptible():
            goals = self._goals() if self.problem.after else list(self.setup.valid_goals)
        while goals:
            found = plan_to(self._to(goals), max(self.deadline.remaining - self.deadline.reserve, LEAST_TIME))
            if not found or found.path is None:
                return self._said(TaskResult.of(found))
            reached = found.path.states[-1]
            try:
                with self._interruptible():
                    timing = None if found.trajectory is None else self.timing
                    plans = self.steps.follow(self.world, reached, timing)
            except StepFailed as failure:
                self.rejected[str(failure)] += 1
                goals = [goal for goal in goals if not np.array_equal(goal, reached)]
                continue
            return self._said(_whole(found, plans, self.robot, self.problem))
        return self._failed()

    def _ends(self) -> bool:
        return self._interrupt.pressed or self.deadline.expired

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """While the block runs, hold Ctrl-C back, and measure the time."""
        with Interrupt() as self._interrupt, running(self._interrupt.end), timed(self._times, "steps"), quiet_ompl():
            yield

    def _said(self, result: TaskResult) -> TaskResult:
        """Return a result of the given problem, with the goals that were examined."""
        times = {**result.times, "steps": self._times["steps"]}
        times["total"] = times.pop("total", 0.0) + self._times["steps"]
        return replace(
            result, problem=self.problem, times=times, goals_examined=self.examined, goals_rejected=dict(self.rejected),
            checks=result.checks + self.steps.checker.check_counts.states,
        )  # fmt: skip

    def _failed(self) -> TaskResult:
        causes = "; ".join(f"{reason} ({n} of {self.examined})" for reason, n in self.rejected.most_common(3))
        late = self._ends() or self.deadline.for_search <= 0.0
        reason = f"{WORDS}{' in time' if late else ''}: {causes or 'none was examined'}"
        made = TaskResult(
            status=PlanStatus.STEP_FAILED, reason=reason, problem=self.problem, robot=self.robot.name,
            joint_names=self.robot.joint_names, planner="task", seed=self.setup.seed,
        )  # fmt: skip
        return self._said(made)

    def _to(self, goals: list[Array]) -> Problem:
        """Return the problem with goal states in place of its goal."""
        names = self.robot.joint_names
        states = tuple(dict(zip(names, goal.tolist(), strict=True)) for goal in goals)
        return self.problem.model_copy(update={"goal": Goal(joints=states), "after": ()})

    def _goals(self) -> list[Array]:
        """Return goals from which all steps can be done, the nearest first."""
        found, share = list[Array](), EXAMINATION * self.deadline.timeout
        for goal in self._candidates():
            late = self.deadline.remaining <= self.deadline.timeout - share
            if self._ends() or self.deadline.for_search <= 0.0 or (found and late):
                break
            self.examined += 1
            try:
                self.steps.follow(self.world, goal, None)
            except StepFailed as failure:
                self.rejected[str(failure)] += 1
                continue
            found.append(goal)
            if len(found) == WANTED:
                break
        return found

    def _candidates(self) -> Iterator[Array]:
        """Yield goals, the nearest first; then others that are sampled, where the goal is in the workspace."""
        goals = self.setup.valid_goals
        durations = direct_durations(self.setup.start, goals, self.robot.limits)
        yield from goals[np.argsort(durations, kind="stable")]
        goal = workspace_goal(self.robot, self.problem)
        if goal is None or self.setup.constraints is not None or len(self.setup.held):
            return
        rng = np.random.default_rng([self.setup.seed, 1])
        for _ in range(ROUNDS):
            yield from sample(goal, self.setup.checker, rng, GOAL_STATES, GOAL_ATTEMPTS).states


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
        deviation=max(found.deviation, *(plan.deviation for plan in plans)),
    )  # fmt: skip


def _step(plan: StepPlan, start: float, end: float, left: float) -> TaskStep:
    """Return the record of a step that was planned."""
    step, world, after = plan.step, plan.world, plan.after
    released = grasped = ()
    if isinstance(step, ReleaseStep):
        released = step.objects or world.held_by(step.hand)
    elif isinstance(step, GraspStep):
        grasped = (step.object,)
    gone = tuple(name for name in released if name not in after.scene and name not in after.held)
    return TaskStep(
        step.kind, step.title, start, end, plan.path, plan.clearance, tuple(world.scene.values()),
        tuple(world.held.values()), tuple(sorted(world.pairs)), left, released, grasped, gone,
    )  # fmt: skip
