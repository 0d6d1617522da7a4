"""Path of a problem: straight line, planner, full check, repair."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from ompl import base as ob

from apex_ompl.errors import ApexError
from apex_ompl.ompl.interrupt import MAX_TIME, ends_after
from apex_ompl.ompl.own_planner import reporting
from apex_ompl.ompl.repair import repair
from apex_ompl.ompl.setup import PlanningSetup, set_goals
from apex_ompl.ompl.simplify import simplify as shorten
from apex_ompl.ompl.space import path_to_array
from apex_ompl.ompl.validity import full_check, motions_until
from apex_ompl.paths.path import Path
from apex_ompl.planning.departure import remedy
from apex_ompl.planning.run import PlanRun
from apex_ompl.result import FIRST, INSIDE, PlanResult, PlanStatus
from apex_ompl.util.forking import unforked
from apex_ompl.util.stopwatch import timed

STRAIGHT_LINE = "straight line"
NOT_PROVED = "a path was found but not proved in time"
REPAIR_SHARE = 0.5  # of the time left, for the repair of one path

Execute = Callable[[PlanRun, ob.Planner, float], PlanStatus]
"""Runs a planner that is set, for a time [s], and returns its status."""


def find_path(run: PlanRun, simplify: bool) -> PlanResult:
    """Return a path that passes the full check, the straight line where it does, or why there is none.

    Args:
        run: The call of ``plan``.
        simplify: Whether paths of planners that leave it to others are shortened.
    """
    result = query_fault(run)
    if result is None:
        result = straight_line(run)
    return solve(run, simplify) if result is None else result


def query_fault(run: PlanRun) -> PlanResult | None:
    """Return the result of a problem whose start is invalid, or all of whose goals are; else None."""
    setup = run.setup
    if setup.start_fault:
        return run.result(PlanStatus.INVALID_START, setup.start_fault + remedy(setup))
    if all(setup.goal_faults):
        return run.result(PlanStatus.INVALID_GOAL, "; ".join(setup.goal_faults))
    return None


def straight_line(run: PlanRun) -> PlanResult | None:
    """Return the straight line to the nearest goal for which it is a solution, or that time is up, or else None.

    Some of OMPL's planners hang, give up or raise where there is nothing to search for.
    """
    setup = run.setup
    with timed(run.times, "line"):
        for goal in sorted(setup.valid_goals, key=lambda goal: float(np.linalg.norm(goal - setup.start))):
            if run.deadline.expired:
                return _out_of_time(run)
            line = np.stack([setup.start, goal])
            if setup.checker.collides_along(line):
                run.rejected_lines.append(line)
                continue
            check = full_check(setup.checker, line, setup.start, setup.goals, deadline=run.deadline.at)
            if check:
                return run.result(
                    PlanStatus.EXACT_SOLUTION, path=Path(line), solved_by=STRAIGHT_LINE, proof=check.proof
                )
            if check.timed_out:
                return run.result(PlanStatus.TIMEOUT, NOT_PROVED)
            run.rejected_lines.append(line)
    return None


def execute(run: PlanRun, planner: ob.Planner, timeout: float) -> PlanStatus:
    """Run a planner that is set, and return its status; faults of the checkers are raised."""
    del planner
    with run.interrupt.ends(ends_after(timeout)) as ptc, timed(run.times, "solve"):
        status = PlanStatus.of(run.setup.simple_setup.solve(ptc))
    run.setup.raise_faults()
    return status


def solve(run: PlanRun, simplify: bool, execute: Execute = execute) -> PlanResult:
    """Run the planner, verify what it finds, and repair it where it fails the full check.

    The planner has what time is left but for the reserve; its set-up does not count.

    Args:
        run: The call of ``plan``.
        simplify: Whether paths of planners that leave it to others are shortened.
        execute: Runs the planner.

    Raises:
        ApexError: The planner cannot be built; a checkpoint is missing, for one.
    """
    try:
        if run.deadline.expired:
            return _out_of_time(run)
        with timed(run.times, "setup"), run.deadline.paused(), unforked():
            planner = _set_up(run)
        with motions_until(run.setup.motion_validator, run.ends_search):
            status = execute(run, planner, min(run.deadline.for_search, MAX_TIME))
        ours = reporting(planner)
        report = run.report = None if ours is None else ours.report
        if report is not None:
            run.times |= {INSIDE + stage: seconds for stage, seconds in report.times.items()}
            if report.solved_by:
                run.times[FIRST] = report.first
        if status is PlanStatus.APPROXIMATE_SOLUTION:
            return _approximate(run)
        if status is not PlanStatus.EXACT_SOLUTION:
            return _unsolved(run, status)
        path = _found_path(run)
        run.first_path = path if report is None or report.first_path is None else report.first_path
        solved_by = run.planner if report is None else report.solved_by
        return verify(run, path, simplify and not run.parameters.smooth, solved_by)
    except ApexError:
        raise
    except Exception as error:
        return run.result(PlanStatus.CRASH, f"{run.planner} failed, {error!r}")


def verify(run: PlanRun, path: Path, simplify: bool, solved_by: str) -> PlanResult:
    """Put the exact start and goal in, shorten the path, check it in full, and repair it where it fails.

    When a shortened path neither passes nor can be repaired, the path as it was found has its turn; each repair has
    half of the time that is left.

    Args:
        run: The call of ``plan``.
        path: Path of the planner.
        simplify: Whether the path is shortened.
        solved_by: What found the path.
    """
    setup, reason, late = run.setup, "", False
    candidates = [with_exact_ends(setup, path)]
    if simplify and not run.ends_search():
        with timed(run.times, "simplify"):
            candidates.insert(0, _simplified(run, candidates[0]))
        setup.raise_faults()
    for candidate in candidates:
        with timed(run.times, "verify"):
            check = full_check(setup.checker, candidate.states, setup.start, setup.goals, deadline=run.deadline.at)
        if check:
            return run.result(PlanStatus.EXACT_SOLUTION, path=candidate, solved_by=solved_by, proof=check.proof)
        if check.timed_out:
            return run.result(PlanStatus.TIMEOUT, NOT_PROVED)
        reason = reason or check.reason
        with timed(run.times, "repair"):
            end = time.perf_counter() + REPAIR_SHARE * run.deadline.remaining
            repaired = repair(setup, candidate.states, check, end, run.interrupt)
        if repaired is not None:
            path, proof = repaired
            return run.result(PlanStatus.EXACT_SOLUTION, path=path, solved_by=f"{solved_by}+repair", proof=proof)
        late |= time.perf_counter() >= end
    failed = "and was not repaired in time" if late else "and repair"
    return run.result(PlanStatus.TIMEOUT, f"the path found failed the full check {failed}, {reason}")


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


def _set_up(run: PlanRun) -> ob.Planner:
    """Return the planner, warm."""
    setup, parameters = run.setup, run.parameters
    simple_setup = setup.simple_setup
    si = simple_setup.getSpaceInformation()
    goals = setup.valid_goals
    if parameters.threaded and len(goals) > 1:
        nearest = goals[int(np.argmin(np.linalg.norm(goals - setup.start, axis=1)))]
        set_goals(simple_setup, [nearest])
        run.notes.append(f"{run.planner} runs threads and takes one goal: the nearest of {len(goals)}")
    if parameters.optimizing:  # others would go on after their first solution, prm for one
        simple_setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
    planner = parameters.build(si)
    simple_setup.setPlanner(planner)
    simple_setup.setup()
    ours = reporting(planner)
    if ours is not None:
        ours.rejected_lines = run.rejected_lines
    return planner


def _found_path(run: PlanRun) -> Path:
    """Return OMPL's solution: the path that the planner added as it, with its spline, or else OMPL's states."""
    solution = run.setup.simple_setup.getSolutionPath()
    ours = None if run.report is None else run.report.path_of(solution)
    return Path(path_to_array(solution, run.setup.robot.dof)) if ours is None else ours


def _simplified(run: PlanRun, path: Path) -> Path:
    return Path(shorten(run.setup.simple_setup.getSpaceInformation(), path.states, run.ends_search))


def _out_of_time(run: PlanRun) -> PlanResult:
    return run.result(PlanStatus.TIMEOUT, f"no path in {run.deadline.timeout:g} s")


def _unsolved(run: PlanRun, status: PlanStatus) -> PlanResult:
    report, details = run.report, "" if status is PlanStatus.TIMEOUT else f" (OMPL says {status})"
    details += f", {report.reason}" if report is not None and report.reason else ""
    ours = PlanStatus.TIMEOUT if status in (PlanStatus.INVALID_START, PlanStatus.INVALID_GOAL) else status
    return run.result(ours, f"{run.planner} found no path in {run.deadline.timeout:g} s{details}")


def _approximate(run: PlanRun) -> PlanResult:
    setup = run.setup
    states = path_to_array(setup.simple_setup.getSolutionPath(), setup.robot.dof)
    states[0] = setup.start
    distance = float(np.linalg.norm(setup.goals - states[-1], axis=1).min())
    reason = f"the nearest state found is {distance:.3g} rad from the goal"
    check = full_check(setup.checker, states, setup.start, deadline=run.deadline.at)
    if check.timed_out:
        reason += ", and the path was not checked in time"
    elif not check:
        reason += f", and the path fails the full check, {check.reason}"
    return run.result(
        PlanStatus.APPROXIMATE_SOLUTION, reason, Path(states), run.planner, check.proof if check else None
    )
