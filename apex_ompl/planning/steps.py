"""The five steps of a plan: assemble, check, solve, prove, time.

Each step takes what the one before it returned::

    setup = assemble(problem)  # robot, checker, state space, start and goals
    query = check(setup, "apex", timeout=5.0)  # true where the start and a goal are valid; the time starts
    found = solve(query)  # a path at the search resolution, with the planner's spline
    proved = prove(found)  # the path that passed the full check, with its certificate
    result = time(proved)  # the timed motion, and all that ``apex_ompl.plan`` returns

A step hands a failure on with its status and reason, so that they can be called in a row. The timeout covers all steps
after ``check``.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from math import nan
from typing import TYPE_CHECKING, Any

import numpy as np
from ompl import base as ob

from apex_ompl import planners
from apex_ompl.apex.parameters import NAME, ApexParameters
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError, ParameterError, TimingError, TimingStoppedError
from apex_ompl.ompl import setup as ompl_setup
from apex_ompl.ompl.constrained_space import CONSTRAINED, ManifoldLength
from apex_ompl.ompl.own_planner import reporting
from apex_ompl.ompl.process import MAX_TIME, ends_after, quiet_ompl, seed_ompl
from apex_ompl.ompl.repair import exact_paths, repair
from apex_ompl.ompl.repair import simplify as shorten
from apex_ompl.ompl.setup import PlanningSetup, set_goals
from apex_ompl.ompl.space import path_to_array
from apex_ompl.ompl.validity import FullCheck, full_check, motions_until
from apex_ompl.paths.path import Path
from apex_ompl.planners import AnyPlanner
from apex_ompl.planning.departure import remedy
from apex_ompl.planning.more_goals import sampled_goal, with_more
from apex_ompl.planning.motions import knows_obstacles, optimized_motion
from apex_ompl.planning.query import Group, planned_joints
from apex_ompl.planning.step_records import FoundPath, PlanQuery, ProvedPath, certificate, constraint_fields
from apex_ompl.result import FIRST, INSIDE, PlanResult, PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.constraints import Constraint
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import TimedPath, Timing, Trajectory, time_path
from apex_ompl.timing.duration import CALM_FACTOR, DEFAULT_OBJECTIVE, check_objective
from apex_ompl.timing.trajectory import ROUNDING
from apex_ompl.types import Array
from apex_ompl.util.clocks import Deadline, timed
from apex_ompl.util.forking import unforked
from apex_ompl.util.validation import check_positive

if TYPE_CHECKING:
    from apex_ompl.constraints.user import UserConstraint

STRAIGHT_LINE = "straight line"
UNNAMED = "unnamed"  # planner of a user's function before it is made
NOT_PROVED = "a path was found but not proved in time"
NOT_TIMED = "a path was found but not timed in time"
CONSTRAINED_DEVIATION = 0.005  # largest deviation of a motion from a path under constraints [rad]
GOAL_SHARE, MORE = 0.5, 2  # of the time, after which more goals are drawn, and number of their random stream
REPAIR_SHARE = 0.5  # of the time left, for the repair of one path


Execute = Callable[[PlanQuery, ob.Planner, float], PlanStatus]
"""Runs a planner that is set, for a time [s], and returns its status."""


def assemble(
    problem: Problem, robot: Robot | None = None, *, seed: int = 0, group: Group | None = None,
    checker: CollisionChecker | None = None, constraints: Sequence[Constraint | UserConstraint] = (),
) -> PlanningSetup:  # fmt: skip
    """Make a problem ready: robot, collision checker, state space, start and goals, and OMPL's seed.

    Args:
        problem: The problem; dynamic obstacles stand where they are at time 0, if they are there then.
        robot: Its robot, when it is loaded already.
        seed: Seed of all random numbers of the plan, OMPL's among them.
        group: Joints that are planned, by names of groups and joints; the others stay as at the start. All by default.
        checker: Collision checker that has the bodies of the problem already.
        constraints: Constraints along the path besides those of the problem.

    Raises:
        ApexError: The robot, a mesh or a joint of the problem, or the frame of a constraint is unknown or faulty, or
            the constraints contradict each other.
    """
    robot = robot or load_robot(problem.robot)
    moving = None if group is None else planned_joints(robot, group)
    seed_ompl(seed)
    return ompl_setup.assemble(problem, robot, seed=seed, checker=checker, moving=moving, constraints=constraints)


def check(
    setup: PlanningSetup, planner: AnyPlanner = NAME, *, params: Mapping[str, Any] | None = None, timeout: float = 5.0,
    objective: str = DEFAULT_OBJECTIVE, calm_factor: float = CALM_FACTOR, timing: bool = False,
    started: float | None = None, times: Mapping[str, float] | None = None, notes: Sequence[str] = (),
) -> PlanQuery:  # fmt: skip
    """Check the start, the goals and the planner's parameters, and start the time of the plan.

    Args:
        setup: What :func:`assemble` returned.
        planner: Name of a planner, its parameters, or a function that makes one for OMPL's space information.
        params: Parameters of the planner by name.
        timeout: Seconds for the steps that follow.
        objective: What the motion is to be, see :func:`apex_ompl.plan`.
        calm_factor: Duration of a calm motion as a multiple of the fastest one's.
        timing: Whether a motion is made: with the parameter ``anytime`` of apex and another objective than ``length``
            it is then improved in place of the path, in the step :func:`time`.
        started: Value of ``time.perf_counter`` when the call of ``plan`` started, by default now [s].
        times: Seconds by stage so far.
        notes: What a user should know about this plan.

    Raises:
        ApexError: The planner, the objective or a parameter is unknown or faulty.
    """
    check_positive(timeout, "timeout", "a positive number of seconds")
    check_objective(objective, calm_factor)
    started = clock.perf_counter() if started is None else started
    parameters = planners.chosen(planner, params, seed=setup.seed)
    improves_motion = timing and objective != "length" and knows_obstacles(setup) and setup.constraints is None
    improves_motion &= isinstance(parameters, ApexParameters) and parameters.anytime
    if improves_motion:
        parameters = parameters.changed(anytime=False)
    if setup.constraints is not None and not parameters.constrained:
        raise ParameterError("planner", parameters.name, CONSTRAINED)
    status, reason, nearest = query_fault(setup)
    name, spent = parameters.name or UNNAMED, dict(times or {})
    return PlanQuery(
        setup, name, parameters, Deadline(timeout), objective, calm_factor, improves_motion, status, reason, started,
        spent, list(notes), nearest_state=nearest,
    )  # fmt: skip


def query_fault(setup: PlanningSetup) -> tuple[PlanStatus | None, str, Array | None]:
    """Return status and reason of an invalid start, or of goals that are all invalid; else None.

    Where constraints along the path are violated, the third is a state on them nearby, or None where none is found.
    """
    if setup.start_fault:
        return PlanStatus.INVALID_START, setup.start_fault + remedy(setup), None
    if setup.start_off:
        return PlanStatus.START_OFF_CONSTRAINT, setup.start_off, _nearest(setup, setup.start)
    if all(setup.goal_faults):
        return PlanStatus.INVALID_GOAL, "; ".join(dict.fromkeys(setup.goal_faults)), None
    if not len(setup.valid_goals):
        k = next(k for k, off in enumerate(setup.goals_off) if off)
        reasons = (fault or off for fault, off in zip(setup.goal_faults, setup.goals_off, strict=True))
        return PlanStatus.GOAL_OFF_CONSTRAINT, "; ".join(dict.fromkeys(reasons)), _nearest(setup, setup.goals[k])
    return None, "", None


def _nearest(setup: PlanningSetup, q: Array) -> Array | None:
    """Return the state on the constraints that a state, shape (dof,), is moved to, or None where it does not arrive."""
    assert setup.constraints is not None
    found = setup.constraints.project(q[None])
    return found.states[0] if found.ok[0] else None


def execute(query: PlanQuery, planner: ob.Planner, timeout: float) -> PlanStatus:
    """Run a planner that is set, and return its status; faults of the checkers are raised."""
    del planner
    with query.interrupt.ends(ends_after(timeout)) as ptc, timed(query.times, "solve"):
        status = PlanStatus.of(query.setup.simple_setup.solve(ptc))
    query.setup.raise_faults()
    return status


def solve(query: PlanQuery, *, lines: bool = True, more: bool = True, execute: Execute = execute) -> FoundPath:
    """Return the straight line to a goal where it is a solution, or else the path that the planner finds.

    The planner has what time is left but for the reserve; its set-up does not count. Where it finds no path to the
    states of a goal in the workspace in half of that, more of them are drawn, and it searches anew for all.

    Args:
        query: What :func:`check` returned.
        lines: Whether straight lines are tried before the planner runs.
        more: Whether more goals are drawn.
        execute: Runs the planner.

    Raises:
        ApexError: The planner cannot be built; a checkpoint is missing, for one.
    """
    if query.status is not None:
        return FoundPath(query, query.status, query.reason)
    found = straight_line(query) if lines else None
    if found is not None:
        return found
    if query.deadline.expired:
        return _out_of_time(query)
    try:
        with quiet_ompl():
            return _searched(query, execute, more)
    except ApexError:
        raise
    except Exception as error:
        return FoundPath(query, PlanStatus.CRASH, f"{query.planner} failed, {error!r}")


def straight_line(query: PlanQuery) -> FoundPath | None:
    """Return the straight line to the nearest goal for which it is a solution, or that time is up, or else None.

    Some of OMPL's planners hang, give up or raise where there is nothing to search for.
    """
    setup = query.setup
    with timed(query.times, "line"):
        for goal in _nearest_first(query):
            if query.deadline.expired:
                return _out_of_time(query)
            line = np.stack([setup.start, goal])
            if setup.checker.collides_along(line):
                query.rejected_lines.append(line)
                continue
            check = _full_check(query, line)
            if check:
                return FoundPath(
                    query, PlanStatus.EXACT_SOLUTION, "", Path(line), STRAIGHT_LINE, check.proof, check.constraints
                )
            if check.timed_out:
                return FoundPath(query, PlanStatus.TIMEOUT, NOT_PROVED)
            query.rejected_lines.append(line)
    return None


def _nearest_first(query: PlanQuery) -> Array:
    """Return the valid goals, the nearest first: in length with that objective, else in time; shape (goals, dof)."""
    start, goals = query.setup.start, query.setup.valid_goals
    if query.objective == "length":
        return goals[np.argsort(np.linalg.norm(goals - start, axis=1), kind="stable")]
    return goals[np.argsort(direct_durations(start, goals, query.setup.robot.limits), kind="stable")]


def prove(found: FoundPath, simplify: bool = True) -> ProvedPath:
    """Put the exact start and goal in, shorten the path, check it in full, and repair it where it fails.

    When a shortened path neither passes nor can be repaired, the path as it was found has its turn; each repair has
    half of the time that is left. A path that ends near a goal is checked as it is.

    Args:
        found: What :func:`solve` returned.
        simplify: Whether paths of planners that leave it to others are shortened.
    """
    query = found.query
    if found.path is None or found.proof is not None:
        return ProvedPath(
            query, found.status, found.reason, found.path, found.solved_by, found.proof, found.constraints
        )
    try:
        with quiet_ompl():
            return _verified(found, found.path, simplify) if found else _checked(found, found.path)
    except ApexError:
        raise
    except Exception as error:
        return ProvedPath(query, PlanStatus.CRASH, f"{query.planner} failed, {error!r}")


def time(proved: ProvedPath, timing: bool | Timing = True) -> PlanResult:
    """Return the result of a plan: its motion by the query's objective, or the status TIMEOUT or TIMING_FAILED.

    The motion keeps the limits and is proved free along its own cubic pieces. With the objective ``length``, where the
    start moves, where a checker that is not this project's decides, or where no motion by the objective is proved, it
    follows the path; else the path of the result is the motion's own.

    Args:
        proved: What :func:`prove` returned; without an exact path nothing is timed.
        timing: How the path is timed, or whether.
    """
    result = proved.result()
    how = Timing() if timing is True else timing
    if isinstance(how, Timing) and proved and proved.path is not None:
        result = _timed(proved.query, proved.path, how, result)
    return finish(proved.query, result)


def finish(query: PlanQuery, result: PlanResult) -> PlanResult:
    """Return a result with its length, the number of states that were checked, and the times up to now."""
    path = None if result.path is None else replace(result.path, weights=query.setup.robot.weights)
    length = nan if path is None else path.length
    times = {**query.times, "total": clock.perf_counter() - query.started}
    return replace(result, path=path, length=length, checks=query.setup.checker.check_counts.states, times=times)


def with_exact_ends(setup: PlanningSetup, path: Path) -> Path:
    """Return a path whose ends are the given start and the nearest goal, bit for bit, as are joints that stay."""
    path = _holding(setup, path)
    goals, states = setup.valid_goals, path.states
    goal = goals[int(np.argmin(np.linalg.norm(goals - states[-1], axis=1)))]
    if np.array_equal(states[0], setup.start) and np.array_equal(states[-1], goal):
        return path
    return Path(np.concatenate([setup.start[None], states[1:-1], goal[None]]))


def _holding(setup: PlanningSetup, path: Path) -> Path:
    """Return a path along which the joints that stay do so bit for bit; the search lets them off by its rounding."""
    held, start = setup.held, setup.start
    if not len(held):
        return path
    states, control = path.states.copy(), None if path.control is None else path.control.copy()
    for array in (states, control):
        if array is not None:
            array[:, held] = start[held]
    return Path(states, path.spline, control)


def _searched(query: PlanQuery, execute: Execute, more: bool) -> FoundPath:
    """Return what the planner finds."""
    times = query.times
    more &= query.setup.problem.goal.joints is None and query.setup.constraints is None
    for share in (GOAL_SHARE, 1.0) if more else (1.0,):
        with timed(times, "setup"), query.deadline.paused(), unforked():
            planner = _set_up(query)
        with motions_until(query.setup.motion_validator, query.ends_search):
            status = execute(query, planner, min(share * query.deadline.for_search, MAX_TIME))
        goal = None if share == 1.0 or status is PlanStatus.EXACT_SOLUTION else sampled_goal(query.setup)
        if goal is None or query.ends_search():
            break
        query.setup, _ = with_more(query.setup, goal, np.random.default_rng([query.setup.seed, MORE]))
        set_goals(query.setup.simple_setup, list(query.setup.goals))
    setup, ours = query.setup, reporting(planner)
    report = query.report = None if ours is None else ours.report
    if report is not None:
        times |= {INSIDE + stage: seconds for stage, seconds in report.times.items()}
        if report.solved_by:
            times[FIRST] = report.first
    if status is PlanStatus.APPROXIMATE_SOLUTION:
        states = path_to_array(setup.simple_setup.getSolutionPath(), setup.robot.dof)
        states[0] = setup.start
        distance = float(np.linalg.norm(setup.goals - states[-1], axis=1).min())
        reason = f"the nearest state found is {distance:.3g} rad from the goal"
        return FoundPath(query, status, reason, Path(states), query.planner)
    if status is not PlanStatus.EXACT_SOLUTION:
        details = "" if status is PlanStatus.TIMEOUT else f" (OMPL says {status})"
        details += f", {report.reason}" if report is not None and report.reason else ""
        ends = status in (PlanStatus.INVALID_START, PlanStatus.INVALID_GOAL)  # which were checked before
        reason = f"{query.planner} found no path in {query.deadline.timeout:g} s{details}"
        return FoundPath(query, PlanStatus.TIMEOUT if ends else status, reason)
    solution = setup.simple_setup.getSolutionPath()
    path = None if report is None else report.path_of(solution)
    path = Path(path_to_array(solution, setup.robot.dof)) if path is None else path
    query.first_path = path if report is None or report.first_path is None else report.first_path
    return FoundPath(query, status, "", path, query.planner if report is None else report.solved_by)


def _set_up(query: PlanQuery) -> ob.Planner:
    """Return the planner, warm."""
    setup, parameters = query.setup, query.parameters
    simple_setup = setup.simple_setup
    si = simple_setup.getSpaceInformation()
    simple_setup.getProblemDefinition().clearSolutionPaths()  # of other planners on the same setup
    goals = setup.valid_goals
    if parameters.threaded and len(goals) > 1:
        nearest = goals[int(np.argmin(np.linalg.norm(goals - setup.start, axis=1)))]
        set_goals(simple_setup, [nearest])
        query.notes.append(f"{query.planner} runs threads and takes one goal: the nearest of {len(goals)}")
    if parameters.optimizing:  # others would go on after their first solution, prm for one
        samples = setup.constraints is not None and not parameters.threaded  # threads deadlock with one in Python
        length = ManifoldLength if samples else ob.PathLengthOptimizationObjective
        simple_setup.setOptimizationObjective(length(si))
    planner = parameters.build(si)
    query.planner = parameters.name or planner.getName()
    simple_setup.setPlanner(planner)
    simple_setup.setup()
    ours = reporting(planner)
    if ours is not None:
        ours.rejected_lines = query.rejected_lines
    return planner


def _out_of_time(query: PlanQuery) -> FoundPath:
    return FoundPath(query, PlanStatus.TIMEOUT, f"no path in {query.deadline.timeout:g} s")


def _verified(found: FoundPath, path: Path, simplify: bool) -> ProvedPath:
    """Return the first of the shortened path and the path itself that passes the full check, or can be repaired."""
    query, solved_by, setup, reason, late = found.query, found.solved_by, found.query.setup, "", False
    candidates = [with_exact_ends(setup, path)]
    if setup.constraints is not None and not query.parameters.smooth:
        nodes, rng = candidates[0].states, np.random.default_rng(setup.seed) if simplify else None
        with timed(query.times, "simplify"):
            exact = exact_paths(setup.checker, setup.constraints, nodes, rng=rng, stop=query.ends_search)
        candidates = [Path(states) for states in exact]
        reason = "" if candidates else "its states cannot be joined on the constraints"
    shortens = simplify and setup.constraints is None and not query.parameters.smooth
    if shortens and path.spline is None and not query.ends_search():
        with timed(query.times, "simplify"):
            si = setup.simple_setup.getSpaceInformation()
            candidates.insert(0, Path(shorten(si, candidates[0].states, query.ends_search)))
        setup.raise_faults()
    for candidate in candidates:
        with timed(query.times, "verify"):
            check = _full_check(query, candidate.states)
        if check:
            return ProvedPath(
                query, PlanStatus.EXACT_SOLUTION, "", candidate, solved_by, check.proof, check.constraints
            )
        if check.timed_out:
            return ProvedPath(query, PlanStatus.TIMEOUT, NOT_PROVED)
        reason = reason or check.reason
        if setup.constraints is not None:
            continue
        with timed(query.times, "repair"):
            end = clock.perf_counter() + REPAIR_SHARE * query.deadline.remaining
            repaired = repair(setup, candidate.states, check, end, query.interrupt)
        if repaired is not None:
            return ProvedPath(query, PlanStatus.EXACT_SOLUTION, "", repaired[0], f"{solved_by}+repair", repaired[1])
        late |= clock.perf_counter() >= end
    failed = "and was not repaired in time" if late else "and repair"
    failed = "" if setup.constraints is not None else f" {failed}"
    return ProvedPath(query, PlanStatus.TIMEOUT, f"the path found failed the full check{failed}, {reason}")


def _full_check(query: PlanQuery, path: Array | Trajectory) -> FullCheck:
    """Return the full check of a path or a motion from the start to a goal."""
    setup = query.setup
    return full_check(
        setup.checker, path, setup.start, setup.goals, deadline=query.deadline.at, constraints=setup.constraints
    )


def _checked(found: FoundPath, path: Path) -> ProvedPath:
    """Return an approximate solution with its certificate, or why it has none."""
    query, setup, reason = found.query, found.query.setup, found.reason
    along = setup.constraints
    if along is not None and not query.parameters.smooth:
        path = next((Path(states) for states in exact_paths(setup.checker, along, path.states)), path)
    check = full_check(setup.checker, path.states, setup.start, deadline=query.deadline.at, constraints=along)
    if check.timed_out:
        reason += ", and the path was not checked in time"
    elif not check:
        reason += f", and the path fails the full check, {check.reason}"
    proof, kept = (check.proof, check.constraints) if check else (None, None)
    return ProvedPath(query, found.status, reason, path, found.solved_by, proof, kept)


def _timed(query: PlanQuery, path: Path, timing: Timing, result: PlanResult) -> PlanResult:
    """Return a result with its motion, or why there is none."""
    setup, limits, names = query.setup, query.setup.robot.limits, query.setup.robot.joint_names
    proof, found = {"motion": 0.0}, list[FullCheck]()
    scaled = timing.limits(limits, names)
    more = timing.motion_limits(setup.robot, setup.problem.attached, setup.problem.payload)

    def check(motion: Trajectory) -> FullCheck:
        with timed(proof, "motion"):
            over = [f"{name} {share:.4f}" for name, share in motion.use(scaled).items() if share > 1.0 + ROUNDING]
            if over:
                return FullCheck(False, f"the share of a limit that it uses is over 1: {', '.join(over)}", None)
            return _full_check(query, motion)

    def fault(motion: Trajectory) -> str:
        found.append(check(motion))
        return found[-1].reason

    made: TimedPath | None = None
    by_objective = query.objective != "length" and timing.start(scaled) is None and knows_obstacles(setup)
    if setup.constraints is not None:
        by_objective &= not setup.constraints.user
        timing = replace(timing, deviation=min(timing.deviation, CONSTRAINED_DEVIATION))
    try:
        with timed(query.times, "timing"):
            if more is not None and (overload := more.gravity_fault(path.states)):
                raise TimingError(overload)
            better = optimized_motion(query, path, timing, check, more) if by_objective else None
            straight = len(path.states) == 2 and query.objective != "calm"  # Ruckig's profile may be faster
            with suppress(*(() if better is None else (TimingError, TimingStoppedError))):
                if straight or better is None:
                    made = time_path(path, limits, names, timing, fault, stop=query.ends, motion_limits=more)
    except TimingStoppedError:
        return replace(result, status=PlanStatus.TIMEOUT, reason=NOT_TIMED)
    except TimingError as error:
        return replace(result, status=PlanStatus.TIMING_FAILED, reason=f"the path cannot be timed, {error}")
    finally:
        query.times["timing"] -= proof["motion"]
        query.times["timing proof"] = proof["motion"]
    motion_proof = found[-1].proof if found else None
    if better is not None and (made is None or better.timed.trajectory.duration < made.trajectory.duration):
        made, motion_proof = better.timed, better.motion_proof
        result = replace(result, path=better.path, **certificate(better.path_proof))
    assert made is not None
    if setup.constraints is not None:
        from apex_ompl.constraints.proof import prove_motion

        kept = prove_motion(setup.constraints, made.trajectory)
        result = replace(result, **constraint_fields(setup.constraints, kept))
    use = made.trajectory.use(limits) | ({} if more is None else more.use(made.trajectory))
    return replace(
        result, trajectory=made.trajectory, limit_use=use, deviation=made.deviation,
        timing_method=made.method, motion_clearance=nan if motion_proof is None else motion_proof.clearance,
    )  # fmt: skip
