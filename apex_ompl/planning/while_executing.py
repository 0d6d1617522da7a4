"""Plans of some joints while others execute a known motion: a state in time is (own, given(t)).

1. A path is planned as if the given joints and what they move were not there, and timed. Where its motion, together
   with the given one, is proved, it is the plan.
2. Otherwise the motion is retimed: it waits, slows down or speeds up along its path (:mod:`apex_ompl.moving.retime`).
   The times at which each place of the path is blocked are found at a grid of states. The same is done along a path
   that is free where the given motion has ended.
3. Motions are optimized in space and time (:mod:`apex_ompl.moving.motion_optimizer`), with the given values of the
   others at each sample; not under constraints.

The motion that arrives first is taken. Each is proved by the full check of the motion of all joints, so that the robot
is checked against itself along both.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.conservative import CheckCounts
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.moving import MOST_SPANS
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.moving.given_motion import GivenMotion
from apex_ompl.moving.motion_optimizer import MotionOptimizer
from apex_ompl.moving.retime import Blocked, Query, Retimed, retime_around
from apex_ompl.ompl import setup as ompl_setup
from apex_ompl.ompl.process import Interrupt, quiet_ompl, seed_ompl
from apex_ompl.ompl.setup import PlanningSetup, state_fault
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import Path
from apex_ompl.planners import AnyPlanner
from apex_ompl.planning import motions
from apex_ompl.planning.among_dynamic_obstacles import (
    PATH_STATES,
    RETIMED,
    SPACE_TIME,
    InTime,
    space_time_motion,
    warm_up,
)
from apex_ompl.planning.one_motion import parameters_of
from apex_ompl.planning.options import PlanOptions
from apex_ompl.planning.query import Group, State, joint_values, planned_joints
from apex_ompl.planning.step_records import FoundPath, PlanQuery, constraint_fields
from apex_ompl.planning.steps import check, finish, prove, solve, time
from apex_ompl.planning.world_checkers import WorldCheckers
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot import Robot
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import Timing, Trajectory
from apex_ompl.timing.combination import rest
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import distinct
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.forking import unforked
from apex_ompl.util.process import running

if TYPE_CHECKING:
    from apex_ompl.constraints.user import UserConstraint
    from apex_ompl.scene.constraints import Constraint

STEP = 0.03  # between the times at which states along a path are checked [s]
MOST_TIMES = 400  # largest number of these
SOON = 1e-3  # first time at which a place that is free at the start may be blocked [s]
GROWN = (1, 3)  # cells in time by which blocked ones grow, in turn
SAMPLES = 48  # states that are checked before a motion is proved
SAME_PLACE = 1e-6  # of links that do not move [m]
SAME_START = 1e-6  # largest difference of a start from the given motion [rad]
DEVIATION = 1.5e-3  # of a retimed motion from its path [rad]
SLOWER = 1.05  # than without the given motion, up to which no other motion is sought
END_SHARE = 0.4  # of the remaining time, for the path that is free at the end
SPEED_UP = 4.0  # the latest arrival is after the given motion and so many durations of the own one


@dataclass(frozen=True, eq=False)
class Asked:
    """What is to be planned beside a given motion.

    Attributes:
        given: The given motion.
        planned: Names of the joints that are planned.
        at_end: The start by joint name, with the given joints where they are in the end.
    """

    given: GivenMotion
    planned: tuple[str, ...]
    at_end: Mapping[str, float]

    @classmethod
    def of(cls, robot: Robot, start: State, group: Group | None, motion: Trajectory, offset: float) -> Asked:
        """Check the arguments of a plan.

        Args:
            robot: The robot.
            start: The start, as the given joints are at the offset, or without them.
            group: Joints that are planned; by default all that the motion does not move.
            motion: The given motion.
            offset: Time of it at which the plan starts [s].

        Raises:
            ApexError: One is faulty, they do not agree, or the motion moves joints that are planned.
        """
        given = GivenMotion.of(robot, motion, offset)
        others = [name for name in robot.joint_names if name not in given.joint_names]
        planned = planned_joints(robot, others if group is None else group)
        given.check_apart(planned)
        now, values = given.at(0.0), joint_values(robot, start, "start")
        for name, value in now.items():
            if abs(values.get(name, value) - value) > SAME_START:
                wanted = f"{value:.6g}, as while_executing has at {offset:g} s"
                raise ParameterError(f"start.{name}", values[name], wanted)
        return cls(given, planned, {**values, **given.at(given.duration)})

    def goal_at_end(self, goal: Goal) -> Goal:
        """Return a goal with the given joints where they are in the end, wherever it is states."""
        if goal.joints is not None:
            values = self.given.at(self.given.duration)
            return goal.model_copy(update={"joints": tuple({**one, **values} for one in goal.joints)})
        if goal.any_of is not None:
            return goal.model_copy(update={"any_of": tuple(map(self.goal_at_end, goal.any_of))})
        return goal


@dataclass(frozen=True)
class WhileExecuting(InTime):
    """Context of a plan while other joints execute a motion. The query is among the static obstacles alone.

    Attributes:
        given: The motion of the others.
        checker: The robot in the world.
        first: The start, with the given values at time 0, shape (dof,).
        problem: The problem of the result.
    """

    given: GivenMotion
    checker: CollisionChecker
    first: Array
    problem: Problem

    def optimizer(self) -> MotionOptimizer:
        """Return the optimizer of motions beside the given one."""
        kernel = self.kernel_of(self.checker)
        return MotionOptimizer(kernel, DynamicObstacles(()), self.limits, given=self.given.values)

    def accepts(self, motion: Trajectory) -> bool:
        """Whether the motion of all joints is proved, and that of the planned ones keeps all limits."""
        if self.is_over(motion):
            return False
        both = self.given.combined(motion)
        if not self.checker.are_free(both(np.linspace(0.0, both.duration, SAMPLES))).all():
            return False
        setup = self.query.setup
        return bool(
            full_check(
                self.checker, both, self.first, setup.goals, deadline=self.query.deadline.at,
                constraints=setup.constraints,
            )
        )  # fmt: skip

    def retimed(self, motion: Trajectory) -> Retimed:
        """Return the motion that arrives first along the path of a motion, proved, or why there is none."""
        horizon = self.given.duration + SPEED_UP * motion.duration + 1.0
        times = _Places(self, motion)
        made = Retimed(None, "", 0.0)
        for grown in GROWN:
            query = Query(0.0, 0.0, self.given.duration, horizon, DEVIATION)
            made = retime_around(times.blocked(grown), motion, self.limits, query)
            if made.trajectory is None or self.accepts(made.trajectory):
                return made
        return Retimed(None, made.reason or "the retimed motions are not proved", 0.0)

    def result(self, still: PlanResult, motion: Trajectory, method: str, deviation: float) -> PlanResult | None:
        """Return the result with the motion of all joints, or None where it is not proved."""
        query, setup, both = self.query, self.query.setup, self.given.combined(motion)
        at, along = query.deadline.at, setup.constraints
        proved = full_check(self.checker, both, self.first, setup.goals, deadline=at, constraints=along)
        if not proved or proved.proof is None:
            return None
        for count in PATH_STATES:
            states = both(np.linspace(0.0, both.duration, count))
            states[0], states[-1] = both.positions[0], both.positions[-1]
            check = full_check(self.checker, states, self.first, setup.goals, deadline=at)
            if check:
                break
        else:
            return None
        kept = {} if along is None or proved.constraints is None else constraint_fields(along, proved.constraints)
        solved_by = f"{still.solved_by}+{method}" if method else still.solved_by
        exact = FoundPath(query, PlanStatus.EXACT_SOLUTION, "", Path(states), solved_by, check.proof)
        return replace(
            exact.result(), problem=self.problem, trajectory=both, timing_method=method or still.timing_method,
            limit_use=self.use(motion) | both.use(setup.robot.limits), motion_clearance=proved.proof.clearance,
            deviation=deviation, **kept,
        )  # fmt: skip


def plan_beside(
    checkers: WorldCheckers, problem: Problem, asked: Asked, planner: AnyPlanner | None,
    options: PlanOptions, *, model: str | None, started: float,
) -> PlanResult:  # fmt: skip
    """Plan some joints while others execute a motion, in the world as it is now.

    Args:
        checkers: The checkers of the world, whose lock is held.
        problem: The problem where the given motion has ended.
        asked: The given motion, and the joints that are planned.
        planner: A planner; apex by default.
        options: The options.
        model: Name or folder of the checkpoint that ``apex`` uses; by default its own.
        started: Value of ``time.perf_counter`` when the call started [s].

    Raises:
        ApexError: The planner, a parameter or an option is faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    options.check()
    if not options.timing:
        raise ParameterError("timing", options.timing, "True or a Timing with while_executing")
    if options.leave_contact:
        raise ParameterError("leave_contact", options.leave_contact, "no contact to leave with while_executing")
    timing = Timing() if options.timing is True else options.timing
    parameters = parameters_of(planner, model, options)
    with quiet_ompl(), Interrupt() as interrupt, running(interrupt.end):
        with unforked():
            checker = checkers.now()
            checker.check_counts = CheckCounts()
            motions.warm_up(checker)
            warm_up(checker)
            seed_ompl(options.seed)

        def query_of(setup: PlanningSetup) -> PlanQuery:
            query = check(
                setup, parameters, timeout=options.timeout, objective=options.objective,
                calm_factor=options.calm_factor, started=started, notes=setup.notes,
                times={"setup": perf_counter() - started},
            )  # fmt: skip
            query.interrupt = interrupt
            return query

        return _plan_beside(
            query_of, problem, checker, asked, simplify=options.simplify, timing=timing, seed=options.seed,
            constraints=options.constraints,
        )  # fmt: skip


def _plan_beside(
    query_of: Callable[[PlanningSetup], PlanQuery], problem: Problem, checker: CollisionChecker, asked: Asked, *,
    simplify: bool, timing: Timing, seed: int = 0, constraints: Sequence[Constraint | UserConstraint] = (),
) -> PlanResult:  # fmt: skip
    """Return a motion of some joints while others execute a given one, or why there is none.

    The motion of the result is that of all joints, until both have ended.

    Args:
        query_of: Returns the query of a set-up.
        problem: The problem where the given motion has ended: the given joints of its start and goals are there.
        checker: The robot in the world.
        asked: The given motion, and the joints that are planned.
        simplify: Whether paths of planners that leave it to others are shortened.
        timing: How motions are timed.
        seed: Seed of the goals and of the plan.
        constraints: Constraints along the motion besides those of the problem.

    Raises:
        ApexError: As :func:`apex_ompl.planning.steps.solve`.
    """
    robot, names, given = checker.robot, checker.robot.joint_names, asked.given

    def assembled(problem: Problem, checker: CollisionChecker) -> PlanningSetup:
        return ompl_setup.assemble(problem, robot, seed, checker, asked.planned, constraints=constraints)

    at_end, others = assembled(problem, checker), without(checker, tuple(given.columns.tolist()))
    if at_end.start_fault and not len(at_end.goals):  # goals are not sampled from a start in collision
        at_end = assembled(problem, others)
    first = given.placed(at_end.start, 0.0)
    began = problem.model_copy(update={"start": dict(zip(names, first.tolist(), strict=True))})
    goals = [goal for goal in at_end.valid_goals if not state_fault(checker, goal)]
    states = tuple(dict(zip(names, goal.tolist(), strict=True)) for goal in goals)
    query = query_of(at_end if not states else assembled(_with_goals(problem, states), others))
    fault = state_fault(checker, first)
    if fault:
        return _unsolved(query, began, PlanStatus.INVALID_START, f"at 0 s: {fault}")
    if fault := _given_fault(checker, asked, first, sampled=True):
        return _unsolved(query, began, PlanStatus.INVALID_START, fault)
    if not states:
        reason = query.reason or "; ".join(state_fault(checker, goal) for goal in at_end.valid_goals)
        return _unsolved(query, began, PlanStatus.INVALID_GOAL, f"after the given motion: {reason}")
    if query.status is not None:
        return _unsolved(query, began, query.status, query.reason)
    limits = timing.limits(robot.limits, names)
    context = WhileExecuting(query, timing, limits, given, checker, first, began)
    still = time(prove(solve(query), simplify), timing)
    if not still or still.trajectory is None:
        return replace(still, problem=began)
    with timed(query.times, "given_motion"):
        if context.accepts(still.trajectory):
            found = context.result(still, still.trajectory, "", still.deviation)
        else:
            at_rest = assembled(_with_goals(problem, states), checker)
            found = _in_time(context, still, at_rest, simplify)
    if found is not None:
        return finish(query, found)
    if fault := _given_fault(checker, asked, first, sampled=False):
        return _unsolved(query, began, PlanStatus.INVALID_START, fault)
    reason = f"no motion beside that of {', '.join(given.joint_names)} was found in time"
    return _unsolved(query, began, PlanStatus.TIMEOUT, reason)


def _given_fault(checker: CollisionChecker, asked: Asked, first: Array, *, sampled: bool) -> str:
    """Return why the given motion fails whatever the planned joints do, in one sentence; empty where it does not.

    Args:
        checker: The robot in the world.
        asked: The given motion, and the joints that are planned.
        first: The start, with the given values at time 0, shape (dof,).
        sampled: Whether the motion is proved only where a state of some along it collides.
    """
    names = checker.robot.joint_names
    alone = asked.given.combined(rest(first, 0.0, names))
    if sampled and checker.are_free(alone(np.linspace(0.0, alone.duration, SAMPLES))).all():
        return ""
    columns = tuple(k for k, name in enumerate(names) if name in asked.planned)
    reason = full_check(without(checker, columns), alone, first).reason
    return reason and f"the motion of while_executing itself fails, {reason}"


def _in_time(context: WhileExecuting, still: PlanResult, at_rest: PlanningSetup, simplify: bool) -> PlanResult | None:
    """Return the result with the motion that arrives first, or None.

    Args:
        context: The context.
        still: The path without the given joints, with its motion.
        at_rest: The set-up where the given motion has ended.
        simplify: Whether paths are shortened.
    """
    assert still.trajectory is not None
    best, query = _retimed(context, still), context.query
    enough = SLOWER * still.trajectory.duration
    if (best is None or best.motion.duration > enough) and not at_rest.start_fault:
        deadline = Deadline(max(1e-3, END_SHARE * query.deadline.remaining))
        waiting = replace(query, setup=at_rest, deadline=deadline, rejected_lines=[])
        best = _earlier(best, _retimed(context, time(prove(solve(waiting), simplify), context.timing)))
    for turn in itertools.count():
        if context.stop() or query.setup.constraints is not None:
            break
        if best is not None and (turn > 0 or best.motion.duration <= enough):
            break
        shorter = np.inf if best is None else best.motion.duration
        made = space_time_motion(context, still.trajectory, turn, shorter)
        best = best if made is None else _Found(still, made, SPACE_TIME, 0.0)
    return None if best is None else context.result(*best)


class _Found(NamedTuple):
    """A proved motion of the planned joints, and the path that it was made from."""

    still: PlanResult
    motion: Trajectory
    method: str
    deviation: float


def _retimed(context: WhileExecuting, still: PlanResult) -> _Found | None:
    """Return the retimed motion of a path, or None."""
    if not still or still.trajectory is None:
        return None
    made = context.retimed(still.trajectory)
    deviation = still.deviation + np.sqrt(still.trajectory.dof) * made.deviation
    return None if made.trajectory is None else _Found(still, made.trajectory, RETIMED, float(deviation))


def _earlier(*several: _Found | None) -> _Found | None:
    """Return that of several motions which ends first; None for no motion."""
    return min((one for one in several if one is not None), key=lambda one: one.motion.duration, default=None)


def _unsolved(query: PlanQuery, problem: Problem, status: PlanStatus, reason: str) -> PlanResult:
    return replace(finish(query, FoundPath(query, status, reason).result()), problem=problem)


def _with_goals(problem: Problem, states: Sequence[dict[str, float]]) -> Problem:
    return problem.model_copy(update={"goal": Goal(joints=tuple(states))})


def without(checker: CollisionChecker, columns: tuple[int, ...]) -> CollisionChecker:
    """Return a checker in which what some joints move may touch the rest of the robot and what that holds."""
    links, held = sorted({checker.meshes.solids[k].name for k in range(checker.meshes.links)}), checker.held
    moved = moved_links(checker.robot, columns)
    own = [link for link in links if link in moved] + [name for name, one in held.items() if one.link in moved]
    others = [link for link in links if link not in moved] + [name for name in held if name not in own]
    pairs = [*checker.allowed, *((one, other) for one in own for other in others)]
    return CollisionChecker(checker.robot, checker.obstacles.values(), held.values(), pairs)


@lru_cache(maxsize=16)
def moved_links(robot: Robot, columns: tuple[int, ...]) -> frozenset[str]:
    """Return the links that some joints move."""
    states, (lower, upper) = np.tile(robot.home, (len(columns) + 1, 1)), robot.range_around(robot.home)
    for row, column in enumerate(columns):
        near = robot.home[column] - lower[column] > upper[column] - robot.home[column]
        states[row, column] = lower[column] if near else upper[column]
    data, numbers = robot.model.createData(), {link: robot.link_frame(link) for link in robot.link_names}
    places = list[Array]()
    for q in states:
        pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
        places.append(np.array([data.oMf[k].homogeneous for k in numbers.values()]))
    moves = np.abs(np.array(places) - places[-1]).max(axis=(0, 2, 3), initial=0.0) > SAME_PLACE
    return frozenset(link for link, one in zip(numbers, moves.tolist(), strict=True) if one)


class _Places:
    """When places along a motion are blocked by the given one, at a grid of states."""

    def __init__(self, context: WhileExecuting, motion: Trajectory) -> None:
        self._context, self._motion = context, motion
        given = context.given
        count = min(int(np.ceil(given.duration / STEP)) + 1, MOST_TIMES)
        self._times = np.linspace(0.0, given.duration, count)
        self._values = given.values(self._times)[:, given.columns]
        self._edges: Array = np.empty(0)
        self._free: Flags = np.empty((0, count), bool)

    def blocked(self, grown: int) -> Callable[[Array, float, float], Blocked]:
        """Return the function that tells when places are blocked, longer by so many cells of time."""

        def find(places: Array, start: float, end: float) -> Blocked:
            edges = distinct(places.ravel())
            if not np.isin(edges, self._edges).all():
                self._edges, self._free = edges, self._examined(edges)
            rows = np.searchsorted(self._edges, places)
            blocked: Flags = np.logical_not(self._free[rows])
            return self._spans(places, blocked[:, 0] | blocked[:, 1], grown, end)

        return find

    def _examined(self, edges: Array) -> Flags:
        """Return whether states are free, at each of the edges and of the times, shape (edges, times)."""
        columns, count = self._context.given.columns, len(self._times)
        states = np.repeat(self._motion(edges)[:, None], count, axis=1)
        states[:, :, columns] = self._values
        free = self._context.checker.are_free(states.reshape(-1, states.shape[2]))
        return free.reshape(len(edges), count)

    def _spans(self, places: Array, blocked: Flags, grown: int, end: float) -> Blocked:
        """Return the intervals around blocked times, shape (places, times); the last time stands for all later ones."""
        spans, counts = np.zeros((len(places), MOST_SPANS, 2)), np.zeros(len(places), np.int64)
        step = self._times[1] if len(self._times) > 1 else STEP
        for k, row in enumerate(blocked):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], row, [0]]).astype(np.int8))).reshape(-1, 2)
            found = (edges + np.array([-grown, grown - 1])) * step
            found[edges[:, 1] == len(row), 1] = end
            found[edges[:, 0] > 0, 0] = np.maximum(found[edges[:, 0] > 0, 0], SOON)
            for first, last in found:
                n = counts[k]
                if n and (first <= spans[k, n - 1, 1] or n == MOST_SPANS):
                    spans[k, n - 1, 1] = last
                else:
                    spans[k, n] = first, last
                    counts[k] += 1
        return Blocked(places, spans, counts)
