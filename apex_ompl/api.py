"""The Python planning API: ``load_problem``, ``setup`` and ``plan``."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og

from apex_ompl import planners, problems
from apex_ompl.assembly import PlanningSetup, assemble, set_goals
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.files import is_file
from apex_ompl.interrupt import Interrupt
from apex_ompl.ompl_globals import quiet_ompl, seed_ompl
from apex_ompl.planners.apex_parameters import WITHOUT_MODEL, default_planner
from apex_ompl.problem import Problem
from apex_ompl.repair import repair
from apex_ompl.resolution import FULL_RESOLUTION
from apex_ompl.result import FIRST, INSIDE, PlanResult, PlanStatus
from apex_ompl.simplify import simplify as shorten
from apex_ompl.space import path_length, path_to_array, resample
from apex_ompl.stopwatch import timed
from apex_ompl.validity import full_check

if TYPE_CHECKING:
    pass

Array = NDArray[np.float64]

CLEARANCE_SAMPLES = 32
STRAIGHT_LINE = "straight line"
PROOF_SHARE, LONGEST_PROOF = 0.1, 0.5  # time kept from planners that stop at the timeout only, for repair [1, s]
LONGEST_TIMEOUT = 1e8  # OMPL counts nanoseconds in 64 bits [s]


def load_problem(name_or_path: str | os.PathLike[str]) -> Problem:
    """Return a problem by its name, one of a suite by its id (``shelf/hard/900012``), or one from a YAML file.

    Raises:
        UnknownNameError: No problem of that name, or no such suite or level; the message lists the known ones.
        ParameterError: No such seed, or the rest of an id is no level and seed.
        MissingFileError: The file, or one that it names, cannot be read.
        FileFormatError: The file does not follow the schema.
    """
    text = os.fspath(name_or_path)
    if problems.is_id(text):
        return problems.load(text)
    if is_file(Path(text)) or text.endswith((".yaml", ".yml")):
        return Problem.load(text)
    suite, *levels = text.split("/")
    if levels and suite in problems.suites():
        raise ParameterError("problem", text, f"an id such as {suite}/{problems.suites()[suite][0]}/12, or a file")
    return Problem.load(text) if os.sep in text else problems.load(text)


def setup(problem: Problem | str | os.PathLike[str]) -> og.SimpleSetup:
    """Return OMPL's SimpleSetup of a problem, for planners and tools of OMPL's own.

    Space, verdict, motion validator, start and goals are set, and the default planner is allocated unless another one
    is set. Moving obstacles stand where they are at time 0.

    Raises:
        ApexError: The problem is unknown or faulty.
    """
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    ready = assemble(loaded)
    simple_setup = ready.simple_setup
    simple_setup.setPlannerAllocator(planners.allocator(default_planner(ready.robot.name)))
    return simple_setup


def plan(
    problem: Problem | str | os.PathLike[str],
    planner: str | None = None,
    *,
    timeout: float = 5.0,
    seed: int = 0,
    simplify: bool = True,
    params: Mapping[str, Any] | None = None,
    snapshot: bool = False,
) -> PlanResult:
    """Plan a path and prove it by the full check.

    The straight line to each goal is tried before the planner runs. What the planner finds is shortened unless it is
    smooth, proved, and planned anew where the proof fails.

    Args:
        problem: A problem, its name, or its file.
        planner: Name of a planner, see ``apex_ompl.planners.names()``; by default apex, or rrtconnect+polish for a
            robot that no model ships for.
        timeout: Seconds for finding and repairing a path; shortening, which is capped by counts, comes on top. Of
            planners that stop at the timeout only, a tenth, at most 0.5 s, is kept for repair.
        seed: Seed of all random numbers, 0 or more. The same seed gives the same path for planners that are
            neither stopped by the clock nor threaded, as long as no other thread plans at the same time (OMPL
            seeds one generator per process).
        simplify: Whether to shorten the path that was found.
        params: Parameters of the planner by name.
        snapshot: Plan among moving obstacles as they stand at time 0.

    Returns:
        The result; it is true only for an exact path that passed the full check.

    Raises:
        ApexError: The problem, the planner or a parameter is unknown or faulty.
        KeyboardInterrupt: Ctrl-C was pressed; planning ended in good order first.
    """
    started = time.perf_counter()
    _check_arguments(timeout, seed)
    if planner is not None:
        planners.parameters(planner, **dict(params or {}))  # before the problem is read
    loaded = problem if isinstance(problem, Problem) else load_problem(problem)
    if loaded.moving and not snapshot:
        expected = f"True, since the obstacle {loaded.moving[0]!r} moves and plans hold for one moment only"
        raise ParameterError("snapshot", snapshot, expected)
    with quiet_ompl():
        seed_ompl(seed)
        ready = assemble(loaded, seed=seed)
        notes = [f"snapshot: {', '.join(loaded.moving)} taken to stand still"] if loaded.moving else []
        if planner is None:
            planner = default_planner(ready.robot.name)
            if planner == WITHOUT_MODEL:
                notes.append(f"no model of {ready.robot.name} ships, so {planner} plans")
        parameters = planners.parameters(planner, **dict(params or {}))
        run = _Run(ready, planner, seed, time.perf_counter() - started, tuple(notes))
        with Interrupt() as run.interrupt:
            result = run.solve(parameters, timeout, simplify)
        return run.finish(started, result)


class _Run:
    """One call of ``plan`` on an assembled problem."""

    def __init__(
        self, ready: PlanningSetup, planner: str, seed: int, setup_time: float, notes: tuple[str, ...]
    ) -> None:
        self.ready = ready
        self.planner = planner
        self.interrupt = Interrupt()
        self.times = {"setup": setup_time}
        self.blank = PlanResult(
            status=PlanStatus.UNKNOWN, reason="", problem=ready.problem, robot=ready.robot.name,
            joint_names=ready.robot.joint_names, planner=planner, seed=seed, notes=notes,
        )  # fmt: skip

    def solve(self, parameters: planners.Parameters, timeout: float, simplify: bool) -> PlanResult:
        """Return the result without what ``finish`` adds."""
        ready = self.ready
        if ready.start_fault:
            return self._failed(PlanStatus.INVALID_START, ready.start_fault)
        if all(ready.goal_faults):
            return self._failed(PlanStatus.INVALID_GOAL, "; ".join(ready.goal_faults))
        with timed(self.times, "line"):
            line = self._straight_line()
        if line is not None:
            return self._exact(line, STRAIGHT_LINE)
        try:
            with timed(self.times, "setup"):
                planner = self._set_up(parameters)
            deadline = time.perf_counter() + timeout
            status = self._run_ompl(parameters, timeout)
            report = getattr(planner, "report", None)
            if report is not None:
                self.times |= {INSIDE + stage: seconds for stage, seconds in report.times.items()}
                if report.solved_by:
                    self.times[FIRST] = report.first
            if status is PlanStatus.APPROXIMATE_SOLUTION:
                return self._approximate()
            if status is not PlanStatus.EXACT_SOLUTION:
                said = "" if status is PlanStatus.TIMEOUT else f" (OMPL says {status})"
                said += f", {report.reason}" if report is not None and report.reason else ""
                ours = PlanStatus.TIMEOUT if status in (PlanStatus.INVALID_START, PlanStatus.INVALID_GOAL) else status
                return self._failed(ours, f"{self.planner} found no path in {timeout:g} s{said}")
            states = path_to_array(ready.simple_setup.getSolutionPath(), ready.robot.dof)
            solved_by = self.planner if report is None else report.solved_by
            return self._proved(states, deadline, simplify and not parameters.smooth, solved_by)
        except ApexError:  # a checkpoint that is missing, for one
            raise
        except Exception as error:
            return self._failed(PlanStatus.CRASH, f"{self.planner} failed, {error!r}")

    def _straight_line(self) -> Array | None:
        """Return the straight line to the nearest goal for which it is a solution, or None.

        Some of OMPL's planners hang, give up or raise where there is nothing to search for.
        """
        ready = self.ready
        goals = sorted(ready.valid_goals, key=lambda goal: float(np.linalg.norm(goal - ready.start)))
        lines = (np.stack([ready.start, goal]) for goal in goals)
        free = (line for line in lines if ready.verdict.first_collision(line, FULL_RESOLUTION) is None)
        return next((line for line in free if full_check(ready.verdict, line, ready.start, goals)), None)

    def _set_up(self, parameters: planners.Parameters) -> ob.Planner:
        """Make the planner, warm."""
        simple_setup = self.ready.simple_setup
        si = simple_setup.getSpaceInformation()
        goals = self.ready.valid_goals
        if parameters.threaded and len(goals) > 1:
            nearest = goals[int(np.argmin(np.linalg.norm(goals - self.ready.start, axis=1)))]
            set_goals(simple_setup, [nearest])
            note = f"{self.planner} runs threads and takes one goal: the nearest of {len(goals)}"
            self.blank = replace(self.blank, notes=(*self.blank.notes, note))
        if parameters.optimizing:  # others would go on after their first solution, prm for one
            simple_setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
        planner = parameters.build(si)
        simple_setup.setPlanner(planner)
        simple_setup.setup()
        return planner

    def _run_ompl(self, parameters: planners.Parameters, timeout: float) -> PlanStatus:
        """Run the planner and return its status; faults of the checkers are raised."""
        simple_setup = self.ready.simple_setup
        # A condition made in C++: planners that run threads deadlock with one made in Python.
        if parameters.optimizing:  # it takes all the time there is, and what it finds must still be proved
            timeout -= min(PROOF_SHARE * timeout, LONGEST_PROOF)
        condition = ob.timedPlannerTerminationCondition(min(timeout, LONGEST_TIMEOUT))
        with self.interrupt.ends(condition) as ptc, timed(self.times, "solve"):
            status = PlanStatus.of(simple_setup.solve(ptc))
        self._raise_faults()
        return status

    def _raise_faults(self) -> None:
        fault = self.ready.checker.fault or self.ready.motions.fault
        if fault is not None:
            raise fault

    def finish(self, started: float, result: PlanResult) -> PlanResult:
        """Add clearance, length, counts and times."""
        path = result.path
        checks = self.ready.verdict.tally.states
        if path is not None:
            with timed(self.times, "clearance"):
                states = resample(path, CLEARANCE_SAMPLES)
                clearance = min(self.ready.verdict.clearance(q) for q in states)
            result = replace(result, length=path_length(path), clearance=clearance)
        self.times["total"] = time.perf_counter() - started
        return replace(result, checks=checks, times=dict(self.times))

    def _proved(self, path: Array, deadline: float, simplify: bool, solved_by: str) -> PlanResult:
        """Put the exact start and goal in, shorten the path, prove it, and repair it where it fails.

        When a shortened path can neither be proved nor repaired, the path as it was found has its turn.
        """
        candidates = [self._with_exact_ends(path)]
        if simplify:
            with timed(self.times, "simplify"):
                candidates.insert(0, self._shortened(candidates[0]))
            self._raise_faults()
        ready, reason = self.ready, ""
        for candidate in candidates:
            with timed(self.times, "verify"):
                check = full_check(ready.verdict, candidate, ready.start, ready.goals)
            if check:
                return self._exact(candidate, solved_by)
            reason = reason or check.reason
            with timed(self.times, "repair"):
                mended = repair(ready, candidate, check, deadline, self.interrupt)
            if mended is not None:
                return self._exact(mended, f"{solved_by}+repair")
        return self._failed(PlanStatus.TIMEOUT, f"the path found failed the full check and repair, {reason}")

    def _shortened(self, path: Array) -> Array:
        simple_setup = self.ready.simple_setup
        si = simple_setup.getSpaceInformation()
        return shorten(simple_setup.getPathSimplifier(), si, path, lambda: self.interrupt.pressed)

    def _exact(self, path: Array, solved_by: str) -> PlanResult:
        return replace(self.blank, status=PlanStatus.EXACT_SOLUTION, path=path, solved_by=solved_by)

    def _approximate(self) -> PlanResult:
        ready = self.ready
        simple_setup = ready.simple_setup
        path = path_to_array(simple_setup.getSolutionPath(), ready.robot.dof)
        path[0] = ready.start
        gap = float(np.linalg.norm(ready.goals - path[-1], axis=1).min())
        reason = f"the nearest state found is {gap:.3g} rad from the goal"
        check = full_check(ready.verdict, path, ready.start)
        if not check:
            reason += f", and the path fails the full check, {check.reason}"
        return replace(
            self.blank, status=PlanStatus.APPROXIMATE_SOLUTION, reason=reason, path=path, solved_by=self.planner
        )

    def _with_exact_ends(self, path: Array) -> Array:
        goals = self.ready.valid_goals
        goal = goals[int(np.argmin(np.linalg.norm(goals - path[-1], axis=1)))]
        return np.concatenate([self.ready.start[None], path[1:-1], goal[None]])

    def _failed(self, status: PlanStatus, reason: str) -> PlanResult:
        return replace(self.blank, status=status, reason=reason)


def _check_arguments(timeout: float, seed: int) -> None:
    number = isinstance(timeout, (int, float)) and not isinstance(timeout, bool)
    if not number or not 0.0 < timeout < float("inf"):
        raise ParameterError("timeout", timeout, "a positive number of seconds")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**31:
        raise ParameterError("seed", seed, "a whole number from 0 to 2147483647")
