"""Plans of whole tasks, sequences of motions and steps: choices of goals that make the later steps possible.

A goal is chosen by a rehearsal of the steps and goals after it (:mod:`apex_ompl.planning.task_rehearsal`). Then the
motion to it and the steps up to the next motion are planned and proved, and so on. Where one fails, the next choice is
tried, first of the last motion, then of the one before it; the reasons are counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.goals.any_goal import AnyGoal
from apex_ompl.goals.goal_sampling import sample
from apex_ompl.ompl.process import Interrupt, quiet_ompl
from apex_ompl.ompl.setup import GOAL_ATTEMPTS, GOAL_STATES, PlanningSetup, state_fault
from apex_ompl.planning.options import PlanOptions
from apex_ompl.planning.query import Group
from apex_ompl.planning.steps import assemble, query_fault
from apex_ompl.planning.task_goals import TaskGoal, task_goal
from apex_ompl.planning.task_motion import whole
from apex_ompl.planning.task_overlaps import joints_needed, whole_at_once
from apex_ompl.planning.task_rehearsal import Rehearsal
from apex_ompl.planning.task_result import TaskResult
from apex_ompl.planning.task_steps import StepPlan, StepPlanner
from apex_ompl.planning.task_waypoints import StepFailed
from apex_ompl.planning.task_world import TaskWorld, check_steps
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.identity import digest
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import Timing
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.forking import unforked
from apex_ompl.util.process import running
from apex_ompl.util.validation import check_flag, check_integer

EXAMINATION = 0.5  # of the time, at most, for the search for goals of a motion once one is found
ROUNDS = 7  # of sampling goals, after those of the set-up
ALTERNATIVES = 64  # states of goals of which any will do that follow those of the set-up
MOST_FAILURES = 2  # of one grasp, or another goal of several, after which it is left out of quick rehearsals
THOROUGH = 12  # goals that are rehearsed thoroughly where a quick rehearsal rejects all
MOTION_SHARE = 0.4  # of the time left, for a motion where other choices or further motions follow
MOST_CAUSES = 3  # that a reason names
WORDS = "no goal was found from which the steps after it can be done"

PlanTo = Callable[[Problem, float, bool, Group | None], PlanResult]
"""Plans a problem in a time [s], for joints or all; with True the first motion of the task, which alone has constraints
along it."""


@dataclass(frozen=True)
class TaskSearch:
    """How goals of a task are chosen.

    Attributes:
        goes_back: Whether the steps after a goal are rehearsed before it is chosen, and other choices tried where a
            step fails. Otherwise the nearest goal of each motion is taken, and the task fails where it does not suit.
        wanted: Goals of the last motion among which the planner chooses.
        asynchronous: Whether each step starts as soon as the steps that it needs are done, those of its arm and of its
            objects, while other arms go on; motions move no arm that need not. Nothing is blended then.
    """

    goes_back: bool = True
    wanted: int = 3
    asynchronous: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ParameterError: One is faulty.
        """
        check_flag(self.goes_back, "goes_back")
        check_flag(self.asynchronous, "asynchronous")
        check_integer(self.wanted, "wanted", 1)


class _Choice(NamedTuple):
    """A goal, and goals of the later motions that were rehearsed from it."""

    goal: Array
    later: list[Array]


def plan_task(
    checker: CollisionChecker, problem: Problem, options: PlanOptions, plan_to: PlanTo, search: TaskSearch | None = None
) -> TaskResult:
    """Return the plan of a whole task: what :meth:`apex_ompl.MotionPlanner.plan_task` returns.

    Args:
        checker: Collision checker with the bodies of the problem, which it has again at the end.
        problem: The problem.
        options: The options of the plan.
        plan_to: Plans from goal to goal.
        search: How goals are chosen.

    Raises:
        ApexError: The problem, a step or an option is faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    options.check()
    if search is not None and not isinstance(search, TaskSearch):
        raise ParameterError("search", search, "a TaskSearch")
    check_steps(checker.robot, problem)
    task = TaskPlanner(checker, problem, options, plan_to, search or TaskSearch())
    try:
        return task.plan()
    finally:
        _restore(checker, task.world)


def _restore(checker: CollisionChecker, world: TaskWorld) -> None:
    """Put the bodies of a world into a checker, in their order, on which plans of one seed may depend."""
    checker.become(world.scene, world.held, world.pairs)
    if [*checker.obstacles] == [*world.scene] and [*checker.held] == [*world.held]:
        return
    pairs = enumerate(zip(checker.obstacles, world.scene, strict=True))
    first = next((k for k, (one, other) in pairs if one != other), len(world.scene))
    checker.become(dict(islice(world.scene.items(), first)), {}, ())
    checker.become(world.scene, world.held, world.pairs)


class TaskPlanner:
    """Plans one task.

    Attributes:
        world: The world on the way to the goal.
        rejected: Why a goal could not be chosen, or a step not done -> number of goals.
        examined: Number of goals from which the steps were tried.
    """

    def __init__(
        self, checker: CollisionChecker, problem: Problem, options: PlanOptions, plan_to: PlanTo, search: TaskSearch
    ) -> None:
        """Plan the task of a problem; see :func:`plan_task`."""
        self._checker, self._problem, self._options, self._plan_to = checker, problem, options, plan_to
        self._search = search
        self._timing = Timing() if options.timing is True else options.timing or None
        self._deadline, self._interrupt = Deadline(options.timeout), Interrupt()
        self._times = {"steps": 0.0}
        self.world = TaskWorld.of(checker.robot, problem)
        self.rejected, self.examined = Counter[str](), 0
        self._reasons = dict[str, str]()  # of each cause, that of the first goal that failed by it
        bodies = self.world.scene.values(), self.world.held.values(), self.world.allowed
        mine = CollisionChecker(checker.robot, *bodies)
        self._steps = StepPlanner(mine, problem, self._deadline, lambda: self._interrupt.pressed)
        self._rehearsal = Rehearsal(self._steps, options.seed, self._ends, options.group)
        self._stages = self._rehearsal.stages
        self._first: PlanResult | None = None

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
            return TaskResult.of(self._plan_to(self._problem, given.timeout, True, given.group))
        try:
            plans = self._solved(0, self.world, setup.start, [], setup)
        except NotPlannedError as failure:
            return self._reported(TaskResult.of(failure.result))
        except StepFailed as failure:
            return self._failed(str(failure))
        assert self._first is not None
        with self._interruptible():
            made = whole(self._steps, self._first, plans, self._problem, self._timing)
            if self._search.asynchronous and made.trajectory is not None:
                made = self._asynchronous(made, plans)
        return self._reported(made)

    def _asynchronous(self, made: TaskResult, plans: list[StepPlan]) -> TaskResult:
        """Return the result with steps of several arms at once, or the given one where that is not shorter."""
        if self._problem.constraints or self._options.constraints:
            note = "no steps are done at once, since constraints along the path were proved for one after the other"
            return replace(made, notes=(*made.notes, note))
        assert self._first is not None
        return whole_at_once(self._steps, made, self._first, plans)

    def _ends(self) -> bool:
        return self._interrupt.pressed or self._deadline.for_search <= 0.0

    def _solved(
        self, k: int, world: TaskWorld, q: Array, later: list[Array], setup: PlanningSetup | None = None
    ) -> list[StepPlan]:
        """Return the plans of a stage and those after it.

        Args:
            k: Number of the stage.
            world: The world at its start.
            q: The state at its start, shape (dof,).
            later: Goals that were rehearsed for it and for the stages after it, or none.
            setup: The problem of its motion, if it is assembled already.

        Raises:
            NotPlannedError: The planner found no motion to a goal of the first stage.
            StepFailed: It, or one after it, cannot be done.
        """
        unplanned: PlanResult | None = None
        free = self._steps.departures.parted(world, self._stages[k].move, q)
        for choices in self._choices(k, free, q, later, setup):
            left = list(choices)
            while left and not self._ends():
                found = self._moved(k, free, q, [one.goal for one in left])
                if not found or found.path is None:
                    unplanned = found
                    title = self._stages[k].move.title if k else "goal"
                    self.rejected[f"{title}: {found.status}"] += 1
                    break
                reached = found.path.states[-1]
                chosen = next((one for one in left if np.array_equal(one.goal, reached)), left[0])
                try:
                    return self._finished(k, world, free, found, chosen.later)
                except StepFailed as failure:
                    self._reject(failure)
                    left = [one for one in left if one is not chosen]
                    if not self._search.goes_back:
                        raise
        if unplanned is not None and k == 0:
            raise NotPlannedError(unplanned)
        if unplanned is not None:
            move = self._stages[k].move
            raise StepFailed(f"{move.title}: {unplanned.reason}", f"{move.title}: {unplanned.status}")
        raise StepFailed(WORDS)

    def _finished(
        self, k: int, world: TaskWorld, free: TaskWorld, found: PlanResult, later: list[Array]
    ) -> list[StepPlan]:
        """Return the plan of a motion that was found, those of the steps after it, and of all later stages.

        Args:
            k: Number of the stage.
            world: The world before its motion.
            free: The world during it: hands that touch nothing have left what they released.
            found: The motion.
            later: Goals that were rehearsed for the stages after it, or none.

        Raises:
            StepFailed: A step cannot be done.
        """
        assert found.path is not None
        stage, reached = self._stages[k], found.path.states[-1]
        clearance = found.clearance if found.trajectory is None else found.motion_clearance
        deviation = 0.0 if found.trajectory is None else found.deviation
        move = StepPlan(
            stage.move, free, free, found.path, found.trajectory, clearance, use=found.limit_use, deviation=deviation
        )
        with self._interruptible():
            move = self._steps.departures.kept(world, move)
            plans = self._steps.follow(stage.steps, move.after, reached, self._timing, self._deadline)
        last = [move, *plans][-1]
        further = [] if k + 1 == len(self._stages) else self._solved(k + 1, last.after, last.end, later)
        if k == 0:
            self._first = found
        return [move, *plans, *further]

    def _moved(self, k: int, world: TaskWorld, q: Array, goals: list[Array]) -> PlanResult:
        """Return the plan of the motion of a stage to one of goals."""
        move, time = self._stages[k].move, self._deadline.for_search
        if len(self._stages) > 1 or not self._search.goes_back:
            time *= MOTION_SHARE
        problem = self._problem if k == 0 else world.problem(self._problem, move.goal, q)
        names = self._checker.robot.joint_names
        states = tuple(dict(zip(names, goal.tolist(), strict=True)) for goal in goals)
        problem = problem.model_copy(update={"goal": Goal(joints=states), "after": ()})
        self._checker.become(world.scene, world.held, world.pairs)
        group, others = move.group or self._options.group, None
        if group is None and self._search.asynchronous:
            others = joints_needed(self._checker.robot, q, goals)
        found = self._plan_to(problem, time, k == 0, group or others)
        return found if found or others is None or self._ends() else self._plan_to(problem, time, k == 0, None)

    def _choices(
        self, k: int, world: TaskWorld, q: Array, later: list[Array], setup: PlanningSetup | None
    ) -> Iterator[list[_Choice]]:
        """Yield goals of a stage among which the planner chooses, with goals of the later stages.

        Raises:
            StepFailed: There is no goal.
        """
        stage, last = self._stages[k], k + 1 == len(self._stages)
        with self._interruptible():
            made = task_goal(self._checker.robot, world, self._problem, stage.move, q, group=self._options.group)
            kept = self._kept(made, world, later[0]) if later else None
        if kept is not None:
            yield [_Choice(kept, later[1:])]
        if setup is None:
            self._checker.become(world.scene, world.held, world.pairs)
            with unforked(), quiet_ompl(), self._deadline.paused():
                setup = assemble(
                    made.problem, self._checker.robot, seed=self._options.seed, checker=self._checker,
                    group=stage.move.group or self._options.group,
                )  # fmt: skip
            status, reason, _ = query_fault(setup)
            if status is not None:
                raise StepFailed(f"{stage.move.title}: {reason}", f"{stage.move.title}: {status}")
        if last and not stage.steps:
            yield [_Choice(goal, []) for goal in setup.valid_goals]
        elif not self._search.goes_back:
            yield [_Choice(next(self._candidates(made, setup)), [])]
        else:
            yield from self._rehearsed(k, world, made, setup)

    def _kept(self, made: TaskGoal, world: TaskWorld, q: Array) -> Array | None:
        """Return a rehearsed state as a goal, or None where it is none, now that the steps before it are planned."""
        found = made.refined(q)
        if found is None:
            return None
        self._steps.become(world)
        return None if state_fault(self._steps.checker, found) else found

    def _rehearsed(self, k: int, world: TaskWorld, made: TaskGoal, setup: PlanningSetup) -> Iterator[list[_Choice]]:
        """Yield goals whose later steps can be done as far as a rehearsal shows, a few at a time."""
        found, doubtful = list[_Choice](), list[tuple[Array, str]]()
        wanted = self._search.wanted if k + 1 == len(self._stages) else 1
        until, failed = self._deadline.remaining * (1.0 - EXAMINATION), Counter[int]()
        for goal in self._candidates(made, setup):
            if self._ends() or (found and self._deadline.remaining <= until):
                break
            alternative = made.goal.member_of(goal) if isinstance(made.goal, AnyGoal) else -1
            if alternative >= 0 and failed[alternative] == MOST_FAILURES:
                continue
            self.examined += 1
            try:
                with self._interruptible():
                    found.append(_Choice(goal, self._rehearsal.later_goals(k, world, goal)))
            except StepFailed as failure:
                self._reject(failure)
                failed[alternative] += 1
                doubtful.append((goal, failure.cause))
                continue
            if len(found) == wanted:
                yield found
                found = []
        if found:
            yield found
        for goal, cause in doubtful[:THOROUGH]:
            if self._ends():
                break
            self.rejected[cause] -= 1
            try:
                with self._interruptible():
                    later = self._rehearsal.later_goals(k, world, goal, thorough=True)
            except StepFailed as failure:
                self._reject(failure)
                continue
            yield [_Choice(goal, later)]

    def _candidates(self, made: TaskGoal, setup: PlanningSetup) -> Iterator[Array]:
        """Yield goals, the nearest first; then others that are sampled, where the goal is in the workspace."""
        goals, goal = setup.valid_goals, made.goal
        yield from goals[np.argsort(direct_durations(setup.start, goals, setup.robot.limits), kind="stable")]
        if goal is None or setup.constraints is not None:
            return
        rng = np.random.default_rng([setup.seed, 1])
        if isinstance(goal, AnyGoal):
            yield from made.held_at_start(goal.nearest_states(setup.checker, rng, ALTERNATIVES))
        for _ in range(1 if isinstance(goal, AnyGoal) else ROUNDS):
            found = sample(goal, setup.checker, rng, GOAL_STATES, GOAL_ATTEMPTS).states
            yield from made.held_at_start(found)

    def _reject(self, failure: StepFailed) -> None:
        """Count a failure by its cause, and keep the first reason of each."""
        self.rejected[failure.cause] += 1
        self._reasons.setdefault(failure.cause, str(failure))

    def _reported(self, result: TaskResult) -> TaskResult:
        """Return a result of the given problem, with the goals that were examined."""
        steps = self._times["steps"]
        times = {**result.times, "steps": steps, "total": result.times.get("total", 0.0) + steps}
        return replace(
            result, problem=self._problem, times=times, goals_examined=self.examined,
            goals_rejected=dict(+self.rejected), checks=result.checks + self._steps.checker.check_counts.states,
        )  # fmt: skip

    def _failed(self, reason: str) -> TaskResult:
        """Return the result of a task whose steps cannot be done."""
        counts = (+self.rejected).most_common(MOST_CAUSES)
        causes = "; ".join(f"{cause} ({n} of {self.examined} goals)" for cause, n in counts)
        told = self._reasons.get(counts[0][0], "") if counts else ""
        causes += f"; the first: {told}" if told not in ("", counts[0][0]) else ""
        robot, status = self._checker.robot, PlanStatus.STEP_FAILED
        if self._deadline.for_search <= 0.0:
            reason, status = f"the task was not planned in {self._options.timeout:g} s", PlanStatus.TIMEOUT
        made = TaskResult(
            status=status, reason="; ".join(filter(None, [reason, causes])), problem=self._problem, robot=robot.name,
            joint_names=robot.joint_names, planner="task", seed=self._options.seed, robot_digest=digest(robot),
        )  # fmt: skip
        return self._reported(made)

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
