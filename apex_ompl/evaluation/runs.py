"""Single runs of a benchmark: ``plan`` with OMPL's solve inside of OMPL's Benchmark, or a row's own function.

The time to the first path is counted the same way for every planner (:func:`first_path_proof`).
"""

from __future__ import annotations

import importlib
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from ompl import base as ob
from ompl import tools as ot

from apex_ompl import planners
from apex_ompl.api import load_problem
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.evaluation.rows import Job, load_runner
from apex_ompl.ompl.own_planner import SolveReport, reporting
from apex_ompl.ompl.process import quiet_ompl, seed_ompl
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import path_length
from apex_ompl.planning import PlanQuery, among_dynamic_obstacles, steps
from apex_ompl.planning.among_dynamic_obstacles import STAGES
from apex_ompl.planning.query import dynamic_of
from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.result import FIRST, PlanResult, PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Timing
from apex_ompl.timing.smoothness import jerk
from apex_ompl.types import Array

PROOF = ("verify", "repair")
"""Stages after a planner that make its path an exact solution."""
MEMORY = 16_384.0  # limit of a run [MB]
UPDATES = 0.05  # period at which a planner's progress is read [s]
LOOK = 0.1  # period at which OMPL's Benchmark checks a planner's time limit [s]
RESULT = "result"
NO_PROBLEM, CRASH = "NO_PROBLEM", str(PlanStatus.CRASH)
WARM_UP = "wall/easy/800000"


def first_path_proof(
    checker: CollisionChecker, raw: Array | None, start: Array, goals: Sequence[Array] | Array,
    times: Mapping[str, float],
) -> float:  # fmt: skip
    """Return the time of the proof by which a first path counts as found [s].

    A first path counts when it has passed the full check. Where the returned path needed a repair, the path as the
    planner found it may pass without one: then its own full check counts, which is run and timed here. Otherwise the
    check and repair of the returned path count. The first-path time of a run is the time until the planner has a path,
    plus this.

    Args:
        checker: Collision checker.
        raw: Path as the planner found it, with the exact start and goal, shape (N, dof); None where it is not known.
        start: Start, shape (dof,).
        goals: Goals, each of shape (dof,).
        times: Times of the stages of the run [s], with ``verify``, and ``repair`` where there was one.
    """
    verify = times.get("verify", 0.0)
    if "repair" not in times or raw is None:
        return verify
    started = time.perf_counter()
    passes = full_check(checker, raw, start, goals)
    return time.perf_counter() - started if passes else verify + times["repair"]


Run = dict[str, Any]
"""A run as it is stored, ready for JSON."""


_robots: dict[str, Robot] = {}


@dataclass(eq=False)
class Experiment:
    """Runs a planner in an experiment of ``ompl.tools.Benchmark``, in the place of ``planning.steps.execute``.

    Attributes:
        checks: Number of states that OMPL's experiment itself checked.
        properties: OMPL's properties of the run.
        common: OMPL's parameters of the planner.
    """

    checks: int = 0
    properties: dict[str, str] = field(default_factory=dict)
    common: dict[str, str] = field(default_factory=dict)

    def __call__(self, query: PlanQuery, planner: ob.Planner, timeout: float) -> PlanStatus:
        """Run the planner, and return its status; faults of the checkers are raised.

        Of the query's time only the planner's own counts, not what the experiment measures.
        """
        left = query.deadline.remaining
        check_counts, reports = query.setup.checker.check_counts, list[SolveReport | None]()
        states = [check_counts.states]

        def before_run(_: ob.Planner) -> None:
            seed_ompl(query.setup.seed)  # the experiment itself has drawn and checked states by then
            query.deadline.restart(left)
            states.append(check_counts.states)

        def after_run(*_: object) -> None:  # after it the experiment checks the path, and clears the planner
            states.append(check_counts.states)
            ours = reporting(planner)
            reports.append(None if ours is None else ours.report)

        observed, validator = list[float](), query.setup.motion_validator
        original = validator.check
        if query.parameters.optimizing:
            validator.check = _watched(query, observed)
        experiment = ot.Benchmark(query.setup.simple_setup, "run")
        experiment.addPlanner(planner)
        experiment.setPreRunEvent(before_run)
        experiment.setPostRunEvent(after_run)
        request = ot.Request(request_time(timeout), MEMORY, 1, UPDATES, False, False, False)
        try:
            experiment.benchmark(request)
        finally:
            validator.check = original  # or a reference cycle would keep the whole problem alive
        query.setup.raise_faults()
        self.checks = states[1] - states[0] + check_counts.states - states[2]
        if reports[0] is not None:
            planner.report = reports[0]
        recorded = experiment.getRecordedExperimentData().planners[0]
        self.properties, self.common = recorded.runs[0].to_dict(), recorded.common.to_dict()
        query.times["solve"] = float(self.properties["time REAL"])
        query.deadline.restart(left - query.times["solve"])
        observed += [moment for data in recorded.runsProgressData for moment in _solved_at(data)]
        if observed:
            query.times[FIRST] = min(observed)
        return ompl_status(self.properties)


def request_time(timeout: float) -> float:
    """Return the time limit for OMPL's Benchmark at which a planner ends within a time, or at the first reading [s].

    The Benchmark reads the clock every 0.1 s, and 0.01 s later on an idle core, so that the first reading comes after
    0.11 s. The time returned lies half a period before the last reading that is early enough.
    """
    looks = max(1, math.floor(timeout / LOOK + 1e-6))
    return (looks - 0.5) * LOOK


def _watched(query: PlanQuery, observed: list[float]) -> Callable[[Array, Array], bool]:
    """Return a motion check whose first call after a path was found notes the time since its first call [s]."""
    check, definition = query.setup.motion_validator.check, query.setup.simple_setup.getProblemDefinition()
    started = 0.0

    def watched(first: Array, second: Array) -> bool:
        nonlocal started
        started = started or time.perf_counter()
        if not observed and definition.hasExactSolution():
            observed.append(time.perf_counter() - started)
        return check(first, second)

    return watched


def ompl_status(properties: Mapping[str, str]) -> PlanStatus:
    """Return the status that the planner itself returned, from OMPL's properties of a run."""
    return PlanStatus(ob.PlannerStatus.PlannerStatusType(int(properties["status ENUM"])).name)


def _solved_at(progress: Iterable[Mapping[str, str]]) -> Iterator[float]:
    """Yield the times of a run at which the planner reported a path of finite cost [s]."""
    for moment in progress:
        costs = (float(value) for name, value in moment.items() if name.startswith("best cost"))
        if any(math.isfinite(cost) for cost in costs):
            yield float(moment["time REAL"])


def run(job: Job) -> Run:
    """Return one run; a run that fails unexpectedly counts as not solved and gives the reason.

    For a run by ``plan`` the entry ``RESULT`` is its ``PlanResult``, which the driver may store.

    Raises:
        ApexError: A file, a parameter or a checkpoint is faulty.
    """
    about = job_columns(job)
    try:
        if job.runner:
            return about | _by_runner(job)
        planning, experiment, result = (in_time if load_problem(job.problem).moving else planned)(job)
        return about | columns(planning, experiment, result) | {RESULT: result}
    except SuiteError as error:
        return about | unsolved(NO_PROBLEM, str(error))
    except ApexError:
        raise
    except Exception as error:
        return about | unsolved(CRASH, repr(error))


def job_columns(job: Job) -> Run:
    """Return the columns of a run that are known before it is made."""
    known = {**asdict(job), "params": dict(job.params), "key": job.key}
    if not job.runner:
        del known["runner"]
    return known


def unsolved(status: str, reason: str) -> Run:
    """Return the columns of a run without a result."""
    return {"status": status, "reason": reason, "solved": False, "by": "", "first": None, "total": None, "setup": None,
            "times": {}, "length": None, "raw_length": None, "jerk": None, "raw_jerk": None, "clearance": None,
            "checks": 0, "counts": {}, "properties": {}, "common": {}, "load": None}  # fmt: skip


def _by_runner(job: Job) -> Run:
    """Return the columns of a run that a row's own function makes; ``status`` follows ``solved`` if it has none."""
    with quiet_ompl():
        seed_ompl(job.seed)
        found = dict(load_runner(job.runner)(job))
    status, by = (PlanStatus.EXACT_SOLUTION, job.planner) if found["solved"] else (PlanStatus.TIMEOUT, "")
    return unsolved(str(status), "") | {"by": by, "load": os.getloadavg()[0]} | found


def planned(job: Job) -> tuple[PlanQuery, Experiment, PlanResult]:
    """Return the query of a run, OMPL's experiment, and the result."""
    started, experiment = time.perf_counter(), Experiment()
    with quiet_ompl():
        query = _ready(job, load_problem(job.problem), started)
        # Even where the straight line is a solution, and with the goals that the set-up found.
        found = steps.solve(query, lines=False, more=False, execute=experiment)
        return query, experiment, steps.time(steps.prove(found, job.simplify), timing=False)


def in_time(job: Job, stages: Sequence[str] = STAGES) -> tuple[PlanQuery, Experiment, PlanResult]:
    """Return a run among dynamic obstacles: as :func:`planned`, without OMPL's experiment and with the motion.

    Args:
        job: The run.
        stages: See :func:`apex_ompl.planning.plan_among_dynamic_obstacles`.
    """
    started, problem = time.perf_counter(), load_problem(job.problem)
    dynamic = dynamic_of(problem.scene)
    with quiet_ompl():
        query = _ready(job, problem.still, started)
        query.setup = replace(query.setup, problem=problem)
        among_dynamic_obstacles.warm_up(query.setup.checker)
        result = among_dynamic_obstacles.plan_among_dynamic_obstacles(query, dynamic, job.simplify, Timing(), stages)
        return query, Experiment(), result


def _ready(job: Job, problem: Problem, started: float) -> PlanQuery:
    """Return the query of a run, its seed set."""
    parameters = planners.parameters(job.planner, **job.params)
    if problem.robot not in _robots:
        _robots[problem.robot] = load_robot(problem.robot)
    setup = steps.assemble(problem, _robots[problem.robot], seed=job.seed)
    times = {"setup": time.perf_counter() - started}
    return steps.check(setup, parameters, timeout=job.timeout, started=started, times=times)


def columns(query: PlanQuery, experiment: Experiment, result: PlanResult) -> Run:
    """Return the columns of a run that was planned."""
    times, report = result.times, query.report
    path = result.path.states if result and result.path is not None else None
    # Optimizing planners continue after their first path, which is not kept.
    first_path = None if query.parameters.optimizing else query.first_path
    raw = None if first_path is None else first_path.states
    found = path is not None
    total = sum(times.get(stage, 0.0) for stage in ("solve", "simplify", *PROOF))
    first = times.get(FIRST, times.get("solve", 0.0))
    if result.dynamic_obstacles:  # the run is solved by its motion, which comes last
        first = total = times["total"] - times["setup"]
    elif report is None or not report.first_verified:  # the planner itself did not run the full check
        setup = query.setup
        exact = None if first_path is None else steps.with_exact_ends(setup, first_path).states
        first = min(first + first_path_proof(setup.checker, exact, setup.start, setup.goals, times), total)
    return {
        "status": str(result.status), "reason": result.reason, "solved": found, "by": result.solved_by,
        "first": first if found else None, "total": total, "setup": times.get("setup"), "times": dict(times),
        "length": result.length if path is not None else None,
        "raw_length": path_length(raw) if found and raw is not None else None,
        "jerk": jerk(path) if path is not None and path_length(path) > 0.0 else None,
        "raw_jerk": jerk(raw) if found and raw is not None and path_length(raw) > 0.0 else None,
        "clearance": result.clearance if path is not None and np.isfinite(result.clearance) else None,
        "checks": result.checks - experiment.checks,
        "properties": experiment.properties, "common": experiment.common, "load": os.getloadavg()[0],
        "counts": {} if report is None else {
            "candidates": report.candidates, "proposals": report.proposed, "resamples": report.resampled,
            "repair steps": report.steps, "improvements": report.improved,
        },
    }  # fmt: skip


def _robot_of(problem: str) -> str:
    """Return the robot of a problem; or that of the suites where no problem can be drawn."""
    try:
        return load_problem(problem).robot
    except SuiteError:
        return load_problem(WARM_UP).robot


def warm_up(jobs: Sequence[Job], modules: Sequence[str] = ()) -> dict[str, float]:
    """Load the code and files for the runs of some rows, and return the time of each row's first run [s].

    Args:
        jobs: One job of each row. It is made on the problem ``WARM_UP`` where that has the same robot.
        modules: Modules to import first, which register planners.
    """
    for module in modules:
        importlib.import_module(module)
    seconds = {}
    for job in jobs:
        started = time.perf_counter()
        problem = WARM_UP if _robot_of(job.problem) == _robot_of(WARM_UP) else job.problem
        run(replace(job, experiment="warm-up", problem=problem, seed=0))
        seconds[job.label] = time.perf_counter() - started
    return seconds
