"""Schedules of several arms: each arm has a list of motions, and a motion waits only for those that it needs.

Motions are planned one after the other, each while the other arms execute what is planned of theirs
(:mod:`apex_ompl.planning.while_executing`), from the earliest time at which it may start. The order in which they are
planned decides on who gives way; orders are tried within the time given, and the one with the shortest makespan is
taken. The first is greedy: next is the arm that may start soonest.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.moving.given_motion import GivenMotion
from apex_ompl.ompl.setup import state_fault, workspace_goal
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path
from apex_ompl.planning.query import GoalSampler, check_is_no_line, check_still, planned_joints, state_array
from apex_ompl.planning.schedule_records import (
    MODES,
    ArmStep,
    Mode,
    Schedule,
    ScheduledStep,
    check_are_steps,
    check_disjoint,
    check_steps,
)
from apex_ompl.planning.step_records import certificate
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.identity import digest
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.combination import rest, together, until_rest
from apex_ompl.timing.trajectory import joined
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_name, check_options, check_positive, check_seed

if TYPE_CHECKING:
    from apex_ompl.planning.planner import MotionPlanner
    from apex_ompl.planning.query import State

PLAN_SECONDS = 2.0  # largest time for one motion [s]
OPTIONS = ("simplify", "params", "timing", "objective", "calm_factor", "constraints")
"""Options of plans that motions of a schedule take."""
MOST_FAULTS = 3  # that a reason gives
GREEDY = 0.5  # share of choices that are greedy after the first order
LEAST_GAIN = 1e-6  # of a makespan [s]
PATH_SPACINGS = (0.02, 0.005, 0.001)  # of the states of the path along the whole motion, the first that is proved [s]


@dataclass(frozen=True, eq=False)
class _Node:
    """What is planned so far.

    Attributes:
        motions: Motion of each group from time 0 on; its last state holds.
        done: The planned steps.
        clock: Start of the current round, of synchronous schedules [s].
        moved: Groups that move in it.
    """

    motions: Mapping[str, Trajectory]
    done: tuple[ScheduledStep, ...] = ()
    clock: float = 0.0
    moved: frozenset[str] = frozenset()

    @property
    def end(self) -> float:
        """Time at which all motions have ended [s]."""
        return max(motion.duration for motion in self.motions.values())

    def ends_of(self, names: Sequence[str]) -> float | None:
        """Return the time at which some steps are done [s], or None where one is not planned."""
        ends = {step.name: step.end for step in self.done}
        return max((ends[name] for name in names), default=0.0) if set(names) <= ends.keys() else None


def schedule(
    planner: MotionPlanner, start: State, steps: Sequence[ArmStep], *, timeout: float = 10.0, seed: int = 0,
    mode: Mode = "asynchronous", most_plans: int | None = None, **options: Any,
) -> Schedule:  # fmt: skip
    """Return the schedule with the shortest makespan that is found in a time.

    Args:
        planner: The planner with its world.
        start: The start of all joints.
        steps: The steps; those of a group are done in their order.
        timeout: Seconds for the schedule; the first order is finished all the same, each of its motions in 2 s.
        seed: Seed of the plans and of the orders.
        mode: When motions start: ``asynchronous``, as soon as what they need is done; ``synchronous``, those of all
            arms together, when all have ended; ``sequential``, one at a time.
        most_plans: Number of planned motions after which no further order is begun; by default time alone ends that.
        **options: Of :meth:`apex_ompl.MotionPlanner.plan`: ``simplify``, ``params``, ``timing``, ``objective``,
            ``calm_factor``, ``constraints``.

    Raises:
        ApexError: A step or an option is faulty, or an obstacle moves.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    _check_options(seed, options)
    check_name(mode, "mode", MODES)
    if most_plans is not None:
        check_integer(most_plans, "most_plans", 1)
    until = time.perf_counter() + timeout
    how = _How(mode, seed, options, until, np.inf if most_plans is None else most_plans)
    return _Search(planner, start, steps, how).found()


def replaced(
    planner: MotionPlanner, known: Schedule, group: str, steps: Sequence[ArmStep], *, after: str | None = None,
    seed: int = 0, **options: Any,
) -> Schedule:  # fmt: skip
    """Return a schedule with other steps of one arm, while the others go on as they were planned.

    Steps of the others that wait for one that is replaced still do: one of that name has to be among the new steps, and
    done before they start.

    Args:
        planner: The planner with its world.
        known: The schedule.
        group: The group of the arm.
        steps: Its new steps, which may wait for steps of the others.
        after: Name of its last step that is kept, in the middle of which it may be; by default none is.
        seed: Seed of the plans.
        **options: As of :func:`schedule`.

    Raises:
        ApexError: A step is faulty, the schedule has none of that name, or an obstacle moves.
    """
    _check_options(seed, options)
    if not isinstance(known, Schedule) or not known:
        raise ParameterError("known", known, "a schedule that was found")
    check_name(group, "group", known.motions)
    check_are_steps(steps)
    for step in steps:
        if step.group != group:
            raise ParameterError("steps", f"{step.name!r} of {step.group}", f"steps of {group} alone")
    mine = [step for step in known.steps if step.group == group]
    if after is not None:
        check_name(after, f"step of {group}", [step.name for step in mine])
    end = 0.0 if after is None else next(step.end for step in mine if step.name == after)
    kept = tuple(step for step in known.steps if step.group != group or step.end <= end)
    motions = {**known.motions, group: known.motions[group].before(end)}
    done = [*(step.name for step in kept), *(step.name for step in steps)]
    for waiting in kept:
        for name in waiting.after:
            if name not in done:
                raise ParameterError("steps", ", ".join(done), f"a step {name!r}, which {waiting.name!r} waits for")
    first = known.result.problem.start_state(planner.robot.joint_names)
    return _Search(planner, first, steps, _How("asynchronous", seed, options), _Node(motions, kept)).found()


class _How(NamedTuple):
    """How a schedule is searched for.

    Attributes:
        mode: When motions start.
        seed: Seed of the plans and of the orders.
        options: Options of plans.
        until: Value of ``time.perf_counter`` at which no further order is begun [s].
        most_plans: Number of plans after which none is.
    """

    mode: Mode
    seed: int
    options: Mapping[str, Any]
    until: float = np.inf
    most_plans: float = np.inf


class _Search:
    """Search of the order in which steps are planned."""

    def __init__(
        self, planner: MotionPlanner, start: State, steps: Sequence[ArmStep], how: _How, root: _Node | None = None
    ) -> None:
        """Check the steps, which are added to those of ``root``."""
        robot = planner.robot
        self._planner, self._how = planner, how
        check_steps(steps, () if root is None else root.done)
        self.start = robot.within_limits(state_array(robot, start, "start"))
        self._joints = {step.group: planned_joints(robot, step.group) for step in steps}
        if root is not None:
            self._joints |= {group: motion.joint_names for group, motion in root.motions.items()}
        check_disjoint(self._joints)
        for step in steps:
            _check_goal(planner, self.start, step)
        self._steps = {group: [step for step in steps if step.group == group] for group in self._joints}
        if root is None:
            still = {group: self._standing(names) for group, names in self._joints.items()}
            root = _Node(still)
        self._nodes: dict[tuple[str, ...], _Node | str] = {(): root}
        self._closed = set[tuple[str, ...]]()  # all orders from there are examined
        self.orders, self.plans, self.faults = 0, 0, list[str]()

    def _standing(self, names: Sequence[str]) -> Trajectory:
        columns = [self._planner.robot.joint_names.index(name) for name in names]
        return rest(self.start[columns], 0.0, names)

    def found(self) -> Schedule:
        """Return the schedule with the shortest makespan, while nobody edits the world."""
        planner = self._planner
        with planner.world.locked():
            check_still(planner.world.checker.changing_obstacles)
            if fault := state_fault(planner.checker, self.start):
                return self._schedule(None, PlanStatus.INVALID_START, fault)
            best = self._best()
            if best is not None:
                return self._schedule(best, PlanStatus.EXACT_SOLUTION, "")
            faults = "; ".join([*dict.fromkeys(self.faults)][-MOST_FAULTS:])
            return self._schedule(None, PlanStatus.STEP_FAILED, f"no order of the steps was found: {faults}")

    def _best(self) -> _Node | None:
        """Return the node of the best complete order, or None."""
        rng, best = np.random.default_rng(self._how.seed), None
        while () not in self._closed:
            node = self._descent(rng if best is not None or self.orders else None, best)
            if node is not None and (best is None or node.end < best.end - LEAST_GAIN):
                best = node
            if self._over():
                break
        return best

    def _descent(self, rng: np.random.Generator | None, best: _Node | None) -> _Node | None:
        """Follow one order from the first step on, and return its end, or None where it has none or a later one.

        Args:
            rng: Chooses the next arm; by default the one that may start soonest.
            best: The best order so far.
        """
        order: tuple[str, ...] = ()
        total = sum(map(len, self._steps.values()))
        while True:
            node = self._nodes[order]
            assert isinstance(node, _Node)
            if len(order) == total:
                self._close(order)
                self.orders += 1
                return node
            if best is not None and (node.end >= best.end - LEAST_GAIN or self._over()):
                self._close(order)
                return None
            choices = [group for group in self._choices(node, order) if (*order, group) not in self._closed]
            if not choices:
                self._close(order)
                if self._over():
                    return None
                order = order[:-1]
                if () in self._closed:
                    return None
                continue
            pick = 0 if rng is None or rng.random() < GREEDY else int(rng.integers(len(choices)))
            order = self._entered(order, choices[pick])

    def _over(self) -> bool:
        """Whether no further order is begun."""
        return time.perf_counter() >= self._how.until or self.plans >= self._how.most_plans

    def _close(self, order: tuple[str, ...]) -> None:
        self._closed.add(order)

    def _entered(self, order: tuple[str, ...], group: str) -> tuple[str, ...]:
        """Return the order with one more step of a group; the order itself where the step cannot be planned."""
        longer, node = (*order, group), self._nodes[order]
        if longer not in self._nodes:
            assert isinstance(node, _Node)
            self._nodes[longer] = self._planned(node, self._steps[group][order.count(group)])
        found = self._nodes[longer]
        if isinstance(found, str):
            self.faults.append(found)
            self._close(longer)
            return order
        return longer

    def _choices(self, node: _Node, order: Sequence[str]) -> list[str]:
        """Return the groups that have a next step and may do it, the soonest first."""
        found = list[tuple[float, str]]()
        for group, steps in self._steps.items():
            index = order.count(group)
            if index < len(steps) and node.ends_of(steps[index].after) is not None:
                found.append((self._start(node, steps[index])[0], group))
        return [group for _, group in sorted(found, key=lambda one: one[0])]

    def _start(self, node: _Node, step: ArmStep) -> tuple[float, float, frozenset[str]]:
        """Return when a step starts [s], and the round that it belongs to: its start and the groups that move."""
        needs, own = node.ends_of(step.after), node.motions[step.group].duration
        assert needs is not None
        if self._how.mode == "asynchronous":
            return max(own, needs), 0.0, frozenset()
        in_round = self._how.mode == "synchronous" and step.group not in node.moved
        if in_round and max(own, needs) <= node.clock:
            return node.clock, node.clock, node.moved | {step.group}
        return node.end, node.end, frozenset({step.group})

    def _planned(self, node: _Node, step: ArmStep) -> _Node | str:
        """Return what is planned with one more step, or why that cannot be.

        Where no motion beside those of the others is found, the arm waits until they rest.
        """
        start, clock, moved = self._start(node, step)
        names, own = self._joints[step.group], node.motions[step.group]
        begin, rested = start, max(motion.duration for motion in node.motions.values())
        result = self._plan(node, step, begin)
        if not result and result.status is not PlanStatus.INVALID_GOAL and begin < rested and self._waits(node, begin):
            begin, result = rested, self._plan(node, step, rested)
        if not result or result.trajectory is None:
            return f"{step.name}: {result.reason}"
        motion = until_rest(result.trajectory.selected(names))
        parts = [own, rest(own.positions[-1], begin - own.duration, names), motion]
        whole = joined([*parts, rest(motion.positions[-1], step.hold, names)])
        done = ScheduledStep(step.name, step.group, start, whole.duration, tuple(step.after))
        for waiting in node.done:
            if step.name in waiting.after and waiting.start < done.end:
                return f"{step.name}: it ends at {done.end:.3f} s, and {waiting.name} starts at {waiting.start:.3f} s"
        return _Node({**node.motions, step.group: whole}, (*node.done, done), clock, moved)

    def _plan(self, node: _Node, step: ArmStep, begin: float) -> PlanResult:
        """Return the plan of a step from a time on [s], beside what the other arms do then."""
        others = [motion for group, motion in node.motions.items() if group != step.group]
        moving = any(motion.duration > begin for motion in others)
        left = max(self._how.until - time.perf_counter(), 0.1) if self.orders else PLAN_SECONDS
        given: dict[str, Any] = {"while_executing": together(others), "offset": begin} if moving else {}
        options = {"timeout": min(PLAN_SECONDS, left), "seed": self._how.seed, **self._how.options, **given}
        self.plans += 1
        state = dict(zip(self._planner.robot.joint_names, self._motion(node)(begin).tolist(), strict=True))
        return self._planner.plan(state, step.goal, group=step.group, **options)

    def _waits(self, node: _Node, begin: float) -> bool:
        """Whether an arm that rests from a time on [s] is proved free until the others rest."""
        if self._how.options.get("constraints"):
            return False
        return bool(full_check(self._planner.checker, self._motion(node).after(begin)))

    def _motion(self, node: _Node) -> Trajectory:
        """Return the motion of all joints."""
        still = rest(self.start, 0.0, self._planner.robot.joint_names)
        return GivenMotion.of(self._planner.robot, together([*node.motions.values()])).combined(still)

    def _schedule(self, node: _Node | None, status: PlanStatus, reason: str) -> Schedule:
        """Return the schedule of a complete order, proved as one motion of all joints, or why there is none."""
        reached = node if node is not None else self._nodes[()]
        assert isinstance(reached, _Node)
        planner, robot = self._planner, self._planner.robot
        motion = self._motion(reached)
        problem = planner.problem(motion.positions[0], motion.positions[-1], "schedule")
        result = PlanResult(
            status=status, reason=reason, problem=problem, robot=robot.name, joint_names=robot.joint_names,
            planner="schedule", seed=self._how.seed, robot_digest=digest(robot),
        )  # fmt: skip
        result = result if node is None else self._proved(result, motion)
        steps = tuple(sorted(reached.done, key=lambda step: (step.start, step.end))) if node is not None else ()
        return Schedule(result, steps, dict(reached.motions), self._how.mode, self.orders, self.plans)

    def _proved(self, result: PlanResult, motion: Trajectory) -> PlanResult:
        """Return a result with its motion, where the full check accepts it."""
        checker = self._planner.checker
        check = full_check(checker, motion, motion.positions[0])
        if not check or check.proof is None:
            reason = f"the motion of all joints is not proved, {check.reason}"
            return replace(result, status=PlanStatus.TIMEOUT, reason=reason)
        for spacing in PATH_SPACINGS:
            states = motion(np.linspace(0.0, motion.duration, max(2, int(np.ceil(motion.duration / spacing)) + 1)))
            along = full_check(checker, states)
            if along and along.proof is not None:
                break
        else:
            reason = f"the path along the motion is not proved, {along.reason}"
            return replace(result, status=PlanStatus.TIMEOUT, reason=reason)
        path = Path(states)
        return replace(
            result, path=path, length=path.length, trajectory=motion, solved_by=self._how.mode,
            timing_method="schedule", limit_use=motion.use(self._planner.robot.limits),
            motion_clearance=check.proof.clearance, **certificate(along.proof),
        )  # fmt: skip


def _check_options(seed: int, options: Mapping[str, Any]) -> None:
    """Check options of plans.

    Raises:
        UnknownNameError: There is no such option.
        ParameterError: The seed is faulty, or motions are not timed from rest.
    """
    check_options(options, OPTIONS)
    check_seed(seed)
    timing = options.get("timing", True)
    if not timing or (isinstance(timing, Timing) and (timing.start_velocity or timing.start_acceleration)):
        raise ParameterError("timing", timing, "True or a Timing that starts at rest")


def _check_goal(planner: MotionPlanner, start: Array, step: ArmStep) -> None:
    """Check the goal of a step, unless it is an object that draws states.

    Raises:
        ParameterError: It is faulty, or has an approach.
    """
    if isinstance(step.goal, GoalSampler):
        return
    try:
        problem = planner.problem(start, step.goal, group=step.group)
        check_is_no_line(problem)
        problem.goal_states(planner.robot.joint_names)
        workspace_goal(planner.robot, problem)
    except ApexError as error:
        raise ParameterError(f"steps.{step.name}.goal", step.goal, f"a possible goal ({error})") from None
