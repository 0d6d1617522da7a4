"""Plans among dynamic obstacles of constant velocity, proved in time.

1. A path among the static obstacles is found and timed. Where its motion meets no dynamic obstacle, it is the plan.
2. Otherwise the motion along the path is retimed: it waits, slows down or speeds up (:mod:`apex_ompl.moving.retime`).
3. Motions are optimized in space and time from several paths and durations (:mod:`apex_ompl.moving.motion_optimizer`);
   not under constraints.
4. Where all that fails, paths are planned around the volumes that the dynamic obstacles sweep.

The motion that arrives first is taken.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel import Kernel
from apex_ompl.moving.motion_optimizer import InitialMotion, MotionOptimizer, shortest_duration
from apex_ompl.moving.retime import retime
from apex_ompl.moving.timed_proof import TimedProver
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.optimizer import PERTURBATION_SIZE, Optimizer
from apex_ompl.paths.path import Path
from apex_ompl.planning.step_records import FoundPath, PlanQuery, constraint_fields
from apex_ompl.planning.steps import finish, prove, query_fault, solve, time
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.robot.model import Limits
from apex_ompl.scene.bodies import Obstacle, Sphere
from apex_ompl.scene.scripts import obstacle_at
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.timed_spline import Start, TimedSpline
from apex_ompl.util.clocks import Deadline, timed

RETIMED, SPACE_TIME, SWEPT = "retiming", "space-time", "swept"
STAGES = (RETIMED, SPACE_TIME, SWEPT)
FACTORS = (1.0, 1.3, 1.7, 2.4, 3.5, 5.0)  # durations that are tried, as multiples of that without dynamic obstacles
MARGIN = 0.005  # that motions keep from dynamic obstacles, where the start does [m]
LONGER = 3  # turns, each with durations twice as long as the one before
PATH_STATES = (256, 1024)  # of the path of a motion, the first number for which it is proved
SWEPT_SECONDS = 6.0  # of the dynamic obstacles' motions that paths are planned around [s]
SWEPT_SHARE = 0.3  # of the time that is left, for that
SWEPT_STEP, MOST_COPIES = 0.05, 100  # spacing of their places [m], and the largest number of these
NEAREST_GOALS = 2  # nearest goals of which there are several
PERTURBATIONS = 4  # of the straight line to each goal
LEAST = 0.2  # duration from which on motions are tried where the goal is the start [s]


@dataclass(frozen=True)
class InTime:
    """Context of a plan in time.

    Attributes:
        query: The query, among the static obstacles.
        timing: How motions are timed.
        limits: The limits by it.
    """

    query: PlanQuery
    timing: Timing
    limits: Limits

    def stop(self) -> bool:
        """Whether time is up."""
        return self.query.ends()

    @cached_property
    def motion_limits(self) -> MotionLimits | None:
        """The limits of torques and tool speeds, or None where there are none."""
        setup = self.query.setup
        return self.timing.motion_limits(setup.robot, setup.problem.attached, setup.problem.payload)

    def is_over(self, motion: Trajectory) -> bool:
        """Whether a motion of the planned joints exceeds a limit of torques or tool speeds."""
        return self.motion_limits is not None and bool(self.motion_limits.fault(motion))

    def use(self, motion: Trajectory) -> dict[str, float]:
        """Return the largest share of each limit that a motion uses, those of torques and tool speeds, too."""
        more = {} if self.motion_limits is None else self.motion_limits.use(motion)
        return motion.use(self.query.setup.robot.limits) | more

    @property
    def start(self) -> Start:
        """Position, velocity and acceleration at the start of the motion."""
        q = self.query.setup.start
        derivatives = self.timing.start(self.limits)
        return Start.at_rest(q) if derivatives is None else Start(q, *derivatives)

    def kernel_of(self, checker: CollisionChecker) -> Kernel:
        """Return the kernel of a checker, in which joints that are not planned stay."""
        setup, arrays = self.query.setup, checker.kernel.robot.arrays
        lower, upper = arrays.lower.copy(), arrays.upper.copy()
        lower[setup.held] = upper[setup.held] = setup.start[setup.held]
        return checker.kernel.within(lower, upper)

    def optimizer(self) -> MotionOptimizer:
        """Return the optimizer of motions."""
        raise NotImplementedError

    def accepts(self, motion: Trajectory) -> bool:
        """Whether a motion has a proof."""
        raise NotImplementedError


@dataclass(frozen=True)
class Among(InTime):
    """Context of a plan among dynamic obstacles.

    Attributes:
        prover: Proves motions.
        stages: Those of ``STAGES`` that are tried.
    """

    prover: TimedProver
    stages: Sequence[str] = STAGES

    @property
    def kernel(self) -> Kernel:
        """The kernel among the static obstacles, in which joints that are not planned stay."""
        return self.kernel_of(self.query.setup.checker)

    def optimizer(self) -> MotionOptimizer:
        """Return the optimizer of motions among the obstacles."""
        return MotionOptimizer(self.kernel, self.prover.dynamic, self.limits)

    def fields(self, motion: Trajectory) -> dict[str, Any] | None:
        """Return what a result says of the proof of a motion, or None.

        It is None where the motion is not proved to be clear of the static obstacles, of the dynamic ones and of
        itself, does not keep the constraints or the limits of torques and tool speeds, or does not go from the start
        to a goal.
        """
        setup = self.query.setup
        if self.is_over(motion) or not self.prover.prove(motion, stop=self.stop):
            return None
        along = setup.constraints
        check = full_check(
            setup.checker, motion, setup.start, setup.goals, deadline=self.query.deadline.at, constraints=along
        )
        if not check or check.proof is None:
            return None
        kept = {} if along is None or check.constraints is None else constraint_fields(along, check.constraints)
        return {"motion_clearance": check.proof.clearance} | kept

    def accepts(self, motion: Trajectory) -> bool:
        """Whether a motion has a proof."""
        return self.fields(motion) is not None


def plan_among_dynamic_obstacles(
    query: PlanQuery, dynamic: Sequence[Obstacle], simplify: bool, timing: Timing, stages: Sequence[str] = STAGES
) -> PlanResult:
    """Return a motion among dynamic obstacles, or why there is none.

    Args:
        query: The query, set up without the dynamic obstacles.
        dynamic: The dynamic obstacles, where they are at time 0, when the motion starts.
        simplify: Whether paths of planners that leave it to others are shortened.
        timing: How motions are timed.
        stages: Those of ``STAGES`` that are tried where the path's own motion meets a dynamic obstacle.

    Raises:
        ApexError: As :func:`apex_ompl.planning.steps.solve`.
    """
    setup, problem = query.setup, query.setup.problem
    if query.status is not None:
        return _unsolved(query, query.status, query.reason)
    meets = TimedProver(setup.checker, dynamic, problem.allowed).fault_at_start(setup.start)
    if meets:
        return _unsolved(query, PlanStatus.INVALID_START, f"at 0 s: {meets}")
    prover = TimedProver(setup.checker, dynamic, problem.allowed, margin=MARGIN)
    if prover.fault_at_start(setup.start):
        prover = TimedProver(setup.checker, dynamic, problem.allowed)
    robot = setup.robot
    if setup.constraints is not None:
        stages = [stage for stage in stages if stage != SPACE_TIME]  # which knows no constraints
    among = Among(query, timing, timing.limits(robot.limits, robot.joint_names), prover, stages)
    still = time(prove(solve(query), simplify), timing)
    if not still or still.trajectory is None:
        return still
    with timed(query.times, "dynamic_obstacles"):
        proof = prover.prove(still.trajectory, stop=among.stop)
        found = still if proof else _in_time(among, still, simplify)
    if found is not None:
        return finish(query, replace(found, dynamic_obstacles=tuple(o.name for o in dynamic)))
    reason = f"no motion among the moving obstacles was found in time; that along the path, {proof.reason}"
    return _unsolved(query, PlanStatus.TIMEOUT, reason)


def _unsolved(query: PlanQuery, status: PlanStatus, reason: str) -> PlanResult:
    return finish(query, FoundPath(query, status, reason).result())


def _in_time(among: Among, still: PlanResult, simplify: bool) -> PlanResult | None:
    """Return the result with the motion that arrives first, or None."""
    best: PlanResult | None = None
    if RETIMED in among.stages:
        best = _retimed(among, still)
    if SPACE_TIME in among.stages:
        best = _earlier(best, _by_space_time(among, still, 0, best))
    if best is None and SWEPT in among.stages:
        best = _around_sweeps(among, simplify)
    if SPACE_TIME in among.stages:
        for turn in itertools.count(1):
            if best is not None or among.stop():
                break
            best = _by_space_time(among, still, turn, None)
    return best


def _earlier(first: PlanResult | None, second: PlanResult | None) -> PlanResult | None:
    """Return that of two results whose motion ends earlier; None for no motion."""
    ends = [(r.trajectory.duration, k) for k, r in enumerate((first, second)) if r and r.trajectory is not None]
    return (first, second)[min(ends)[1]] if ends else None


def _retimed(among: Among, still: PlanResult) -> PlanResult | None:
    """Return the result with its motion retimed, or None."""
    motion, kernel = still.trajectory, among.kernel
    assert motion is not None
    made = retime(kernel, among.prover.dynamic, motion, among.limits, hold=0.0)
    fields = None if made.trajectory is None else among.fields(made.trajectory)
    if made.trajectory is None or fields is None:
        return None
    return replace(
        still, trajectory=made.trajectory, solved_by=f"{still.solved_by}+{RETIMED}", timing_method=RETIMED,
        deviation=still.deviation + math.sqrt(motion.dof) * made.deviation,
        limit_use=among.use(made.trajectory), **fields,
    )  # fmt: skip


def _by_space_time(among: Among, still: PlanResult, turn: int, best: PlanResult | None) -> PlanResult | None:
    """Return the result with a motion that is optimized in space and time and ends before the best one, or None."""
    motion, known = still.trajectory, None if best is None else best.trajectory
    assert motion is not None
    found = space_time_motion(among, motion, turn, math.inf if known is None else known.duration)
    return None if found is None else _result(among, still, found, SPACE_TIME)


def space_time_motion(context: InTime, motion: Trajectory, turn: int, shorter: float = math.inf) -> Trajectory | None:
    """Return the motion that is optimized in space and time and ends first, or None.

    Args:
        context: The context.
        motion: That along the path among the static obstacles.
        turn: Number of times that it was called before; perturbations become larger.
        shorter: Motions that take no less are skipped [s].
    """
    optimizer, found = context.optimizer(), None
    for factor in FACTORS:
        for initial in _initial_motions(context.query, context.limits, motion, turn):
            duration = factor * 2.0 ** min(turn, LONGER) * max(initial.duration, LEAST)
            if context.stop():
                break
            if duration >= shorter:
                continue
            spline = TimedSpline.along(initial.states, duration, context.start, initial.goal)
            better = optimizer.repair(spline, context.accepts, stop=context.stop)
            if better is not None and better.duration < shorter:
                found, shorter = better, better.duration
        if found is not None:
            break
    return found


_warm: set[str] = set()  # robots of which the code is loaded


def warm_up(checker: CollisionChecker) -> None:
    """Load or compile the code that only plans among dynamic obstacles need, so that no plan waits for it."""
    robot = checker.robot
    if robot.name in _warm:
        return
    start, goal = robot.home, robot.home + np.where(np.arange(robot.dof) == 0, 0.5, 0.0)
    motion = time_path(np.stack([start, goal]), robot.limits, robot.joint_names, Timing(method="spline")).trajectory
    hand = robot.link_pose(motion(0.5 * motion.duration), robot.link_names[-1])[:3, 3]
    far = tuple((hand + (0.0, 0.0, 0.5 * motion.duration)).tolist())
    checker = CollisionChecker(robot)  # of its own: all names are free in it
    ball = Obstacle(name="ball", sphere=Sphere(radius=0.05), position=far, velocity=(0, 0, -1))
    prover = TimedProver(checker, [ball])
    prover.prove(motion)
    retime(checker.kernel, prover.dynamic, motion, robot.limits, hold=0.0)
    spline = TimedSpline.along(motion(motion.times), motion.duration, Start.at_rest(start), goal)
    MotionOptimizer(checker.kernel, prover.dynamic, robot.limits).improve(spline, steps=1)
    _warm.add(robot.name)


def _around_sweeps(among: Among, simplify: bool) -> PlanResult | None:
    """Return the motion of a path around the volumes that the dynamic obstacles sweep, or None."""
    query, robot, problem = among.query, among.query.setup.robot, among.query.setup.problem
    names = [name for k, name in enumerate(robot.joint_names) if k not in query.setup.held]
    swept = [copy for o in among.prover.obstacles for copy in _sweep(o)]
    blocked = problem.still.model_copy(update={"scene": (*problem.still.scene, *swept)})
    further = query.setup.further_constraints
    setup = assemble(blocked, robot, seed=query.setup.seed, moving=names, constraints=further)
    setup = replace(setup, problem=problem)
    deadline = Deadline(max(1e-3, SWEPT_SHARE * query.deadline.remaining))
    status, reason, _ = query_fault(setup)
    inner = replace(query, setup=setup, deadline=deadline, status=status, reason=reason, rejected_lines=[])
    found = time(prove(solve(inner), simplify), among.timing)
    if not found or found.trajectory is None or not among.accepts(found.trajectory):
        return None
    return replace(found, solved_by=f"{found.solved_by}+{SWEPT}")


def _sweep(obstacle: Obstacle) -> list[Obstacle]:
    """Return copies of an obstacle along its path."""
    length = SWEPT_SECONDS * float(np.linalg.norm(obstacle.velocity or (0.0, 0.0, 0.0)))
    times = np.linspace(0.0, SWEPT_SECONDS, min(MOST_COPIES, 2 + int(length / SWEPT_STEP)))
    return [
        obstacle_at(obstacle, float(t)).model_copy(update={"name": f"{obstacle.name} at {t:.2f} s", "velocity": None})
        for t in times
    ]


def _result(among: Among, still: PlanResult, motion: Trajectory, method: str) -> PlanResult | None:
    """Return a result with another motion and with its path, or None."""
    query, fields = among.query, among.fields(motion)
    if fields is None:
        return None
    for count in PATH_STATES:
        times = np.linspace(0.0, motion.duration, count)
        states = motion(times)
        check = full_check(
            query.setup.checker, states, query.setup.start, query.setup.goals, deadline=query.deadline.at
        )
        if check:
            break
    else:
        return None
    largest = np.linalg.norm(np.abs(motion.accelerations).max(axis=0))
    solved_by = f"{still.solved_by}+{method}"
    exact = FoundPath(query, PlanStatus.EXACT_SOLUTION, "", Path(states), solved_by, check.proof)
    return replace(
        exact.result(), trajectory=motion, limit_use=among.use(motion), timing_method=method,
        deviation=float(largest * (times[1] - times[0]) ** 2 / 8.0), **fields,
    )  # fmt: skip


def _initial_motions(query: PlanQuery, limits: Limits, motion: Trajectory, turn: int) -> Iterator[InitialMotion]:
    """Yield motions to start from: the path's own, straight lines, and random perturbations of them.

    Args:
        query: The query, among the static obstacles.
        limits: Those of the motion.
        motion: The path's own.
        turn: Number of times that they were asked for before; perturbations become larger.
    """
    optimizer, held = Optimizer(), query.setup.held
    if turn == 0:
        states = motion(np.linspace(0.0, motion.duration, 256))
        yield InitialMotion(states, states[-1], motion.duration, timed=True)
    goals, rng = query.setup.valid_goals, np.random.default_rng([query.setup.seed, turn])
    for goal in goals[np.argsort(np.linalg.norm(goals - query.setup.start, axis=1))][:NEAREST_GOALS]:
        size = PERTURBATION_SIZE * (1 + turn % 3)
        for control in optimizer.starts(query.setup.start, goal, PERTURBATIONS, rng, size):
            control[:, held] = query.setup.start[held]
            states = optimizer.spline.path(control)
            yield InitialMotion(states, states[-1], shortest_duration(states, limits, even=True))
            if turn > 0:  # aside, back, and then along the line
                aside = states - optimizer.spline.path(optimizer.spline.line(states[0], goal))
                line = np.linspace(states[0], goal, len(states))
                around = np.concatenate([states[0] + aside, line])
                yield InitialMotion(around, goal, shortest_duration(line, limits, even=True))
