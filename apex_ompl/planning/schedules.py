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
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.moving.given_motion import GivenMotion, rest, together, until_rest
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path
from apex_ompl.planning.query import Target, joint_values, planned_joints, state_array
from apex_ompl.planning.step_records import certificate
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.model import digest
from apex_ompl.timing import Trajectory
from apex_ompl.timing.trajectory import joined
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_integer, check_name, check_number, check_positive, check_seed

if TYPE_CHECKING:
    from apex_ompl.planning.planner import MotionPlanner
    from apex_ompl.planning.query import State

Mode = Literal["asynchronous", "synchronous", "sequential"]
MODES: tuple[Mode, ...] = ("asynchronous", "synchronous", "sequential")
"""When a motion starts: as soon as what it needs is done; with those of the other arms; when all others have ended."""

PLAN_SECONDS = 2.0  # largest time for one motion [s]
MOST_FAULTS = 3  # that a reason gives
GREEDY = 0.5  # share of choices that are greedy after the first order
LEAST_GAIN = 1e-6  # of a makespan [s]
PATH_SPACING = 0.02  # of the states of the path along the whole motion [s]


@dataclass(frozen=True)
class ArmStep:
    """One motion of an arm.

    Attributes:
        name: Its name, which no other step has.
        group: The group of joints that it moves.
        goal: Where to: a goal of :meth:`apex_ompl.MotionPlanner.plan` for that group.
        after: Names of steps of other arms that have to be done before it starts.
        hold: Time for which the arm stays there then [s].
    """

    name: str
    group: str
    goal: Target
    after: tuple[str, ...] = ()
    hold: float = 0.0


@dataclass(frozen=True)
class ScheduledStep:
    """When a step is done.

    Attributes:
        name: Its name.
        group: Its group.
        start: Time at which it may start [s]; the arm may wait then.
        end: Time at which the arm rests at its goal, and has held it [s].
    """

    name: str
    group: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Schedule:
    """A schedule; true where all steps are planned and the motion of all joints is proved.

    Attributes:
        result: The whole as the result of a plan: status, reason, and the proved motion of all joints.
        steps: The steps by their start.
        motions: Motion of each group from time 0 to its last step's end.
        mode: When motions start.
        orders: Number of complete orders that were examined.
        plans: Number of motions that were planned.
    """

    result: PlanResult
    steps: tuple[ScheduledStep, ...]
    motions: Mapping[str, Trajectory]
    mode: Mode
    orders: int
    plans: int

    def __bool__(self) -> bool:
        """Whether all steps are planned and proved."""
        return bool(self.result)

    def __repr__(self) -> str:
        """Return the status, the steps and the makespan."""
        names = ", ".join(step.name for step in self.steps)
        return one_line("Schedule", self.mode, str(self.result.status), names, f"{self.makespan:.3f} s", self.reason)

    @property
    def reason(self) -> str:
        """Why there is no schedule, in one sentence."""
        return self.result.reason

    @property
    def trajectory(self) -> Trajectory | None:
        """The motion of all joints, or None."""
        return self.result.trajectory

    @property
    def makespan(self) -> float:
        """Time at which the last step ends [s]; NaN without steps."""
        return max((step.end for step in self.steps), default=float("nan"))


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
        **options: Further ones of :meth:`apex_ompl.MotionPlanner.plan`.

    Raises:
        ApexError: A step or an option is faulty.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    check_seed(seed)
    check_name(mode, "mode", MODES)
    if most_plans is not None:
        check_integer(most_plans, "most_plans", 1)
    until = time.perf_counter() + timeout
    how = _How(mode, seed, options, until, np.inf if most_plans is None else most_plans)
    search = _Search(planner, start, steps, how)
    with planner.world.locked():
        best = search.best()
        return search.schedule(best)


def replaced(
    planner: MotionPlanner, known: Schedule, group: str, steps: Sequence[ArmStep], *, after: str | None = None,
    seed: int = 0, **options: Any,
) -> Schedule:  # fmt: skip
    """Return a schedule with other steps of one arm, while the others go on as they were planned.

    Args:
        planner: The planner with its world.
        known: The schedule.
        group: The group of the arm.
        steps: Its new steps, which may wait for steps of the others.
        after: Name of its last step that is kept, in the middle of which it may be; by default none is.
        seed: Seed of the plans.
        **options: Further ones of :meth:`apex_ompl.MotionPlanner.plan`.

    Raises:
        ApexError: A step is faulty, or the schedule has none of that name.
    """
    check_name(group, "group", known.motions)
    mine = [step for step in known.steps if step.group == group]
    if after is not None:
        check_name(after, f"step of {group}", [step.name for step in mine])
    end = 0.0 if after is None else next(step.end for step in mine if step.name == after)
    kept = tuple(step for step in known.steps if step.group != group or step.end <= end)
    motions = {**known.motions, group: known.motions[group].before(end)}
    first = known.result.problem.start_state(planner.robot.joint_names)
    search = _Search(planner, first, steps, _How("asynchronous", seed, options), _Node(motions, kept))
    with planner.world.locked():
        return search.schedule(search.best())


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
        known = () if root is None else root.done
        _check_steps(steps, known)
        values = joint_values(robot, start, "start")
        self.start = state_array(robot, values, "start")
        self._joints = {step.group: planned_joints(robot, step.group) for step in steps}
        if root is not None:
            self._joints |= {group: motion.joint_names for group, motion in root.motions.items()}
        _check_disjoint(self._joints)
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

    def best(self) -> _Node | None:
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
        """Return what is planned with one more step, or why that cannot be."""
        begin, clock, moved = self._start(node, step)
        group, names = step.group, self._joints[step.group]
        robot, own = self._planner.robot, node.motions[step.group]
        others = [motion for other, motion in node.motions.items() if other != group]
        now = dict(zip(robot.joint_names, self.start.tolist(), strict=True))
        for motion in (own, *others):
            now |= dict(zip(motion.joint_names, motion(begin).tolist(), strict=True))
        beside = together(others) if others and max(m.duration for m in others) > begin else None
        left = max(self._how.until - time.perf_counter(), 0.1) if self.orders else PLAN_SECONDS
        given: dict[str, Any] = {} if beside is None else {"while_executing": beside, "offset": begin}
        options = {"timeout": min(PLAN_SECONDS, left), "seed": self._how.seed, **self._how.options, **given}
        self.plans += 1
        result = self._planner.plan(now, step.goal, group=group, **options)
        if not result or result.trajectory is None:
            return f"{step.name}: {result.reason}"
        motion = until_rest(result.trajectory.selected(names))
        parts = [own, rest(own.positions[-1], begin - own.duration, names), motion]
        whole = joined([*parts, rest(motion.positions[-1], step.hold, names)])
        done = ScheduledStep(step.name, group, begin, whole.duration)
        return _Node({**node.motions, group: whole}, (*node.done, done), clock, moved)

    def schedule(self, node: _Node | None) -> Schedule:
        """Return the schedule of a complete order, proved as one motion of all joints."""
        reached = node if node is not None else self._nodes[()]
        assert isinstance(reached, _Node)
        planner, robot = self._planner, self._planner.robot
        still = rest(self.start, 0.0, robot.joint_names)
        motion = GivenMotion.of(robot, together([*reached.motions.values()])).combined(still)
        problem = planner.problem(motion.positions[0], motion.positions[-1], "schedule")
        faults = [*dict.fromkeys(self.faults)][-MOST_FAULTS:]
        result = PlanResult(
            status=PlanStatus.TIMEOUT, reason=f"no order of the steps was found: {'; '.join(faults)}",
            problem=problem, robot=robot.name, joint_names=robot.joint_names, planner="schedule", seed=self._how.seed,
            robot_digest=digest(robot),
        )  # fmt: skip
        if node is not None:
            result = self._proved(replace(result, reason=""), motion)
        steps = tuple(sorted(reached.done, key=lambda step: (step.start, step.end))) if node is not None else ()
        return Schedule(result, steps, dict(reached.motions), self._how.mode, self.orders, self.plans)

    def _proved(self, result: PlanResult, motion: Trajectory) -> PlanResult:
        """Return a result with its motion, where the full check accepts it."""
        checker = self._planner.checker
        check = full_check(checker, motion, motion.positions[0])
        if not check or check.proof is None:
            return replace(result, reason=f"the motion of all joints is not proved, {check.reason}")
        path = Path(motion(np.linspace(0.0, motion.duration, max(2, int(motion.duration / PATH_SPACING)))))
        return replace(
            result, status=PlanStatus.EXACT_SOLUTION, path=path, length=path.length, trajectory=motion,
            solved_by=self._how.mode, timing_method="schedule", limit_use=motion.use(self._planner.robot.limits),
            motion_clearance=check.proof.clearance, **certificate(check.proof),
        )  # fmt: skip


def _check_steps(steps: Sequence[ArmStep], known: Sequence[ScheduledStep]) -> None:
    """Check names and order of steps.

    Raises:
        ParameterError: No step, a name given twice, a negative time, or steps that wait for each other.
        UnknownNameError: A step waits for one that there is not.
    """
    if not steps or not all(isinstance(step, ArmStep) for step in steps):
        raise ParameterError("steps", steps, "one ArmStep or more")
    names = [*(step.name for step in known), *(step.name for step in steps)]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError("steps", f"two steps {name!r}", "names that differ")
    for step in steps:
        check_number(step.hold, f"steps.{step.name}.hold", 0.0)
        for other in step.after:
            check_name(other, f"step in steps.{step.name}.after", names)
    done = {step.name for step in known}
    left = {group: [s for s in steps if s.group == group] for group in dict.fromkeys(s.group for s in steps)}
    while any(left.values()):
        ready = [some for some in left.values() if some and set(some[0].after) <= done]
        if not ready:
            stuck = ", ".join(some[0].name for some in left.values() if some)
            raise ParameterError("steps", stuck, "steps that do not wait for each other in a circle")
        for some in ready:
            done.add(some.pop(0).name)


def _check_disjoint(joints: Mapping[str, Sequence[str]]) -> None:
    """Check that no joint is in two groups.

    Raises:
        ParameterError: One is.
    """
    owners = dict[str, str]()
    for group, names in joints.items():
        for name in names:
            if owners.setdefault(name, group) != group:
                raise ParameterError("steps", f"{owners[name]} and {group}", f"groups that do not share {name}")
