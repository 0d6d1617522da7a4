"""One run of a benchmark: ``plan`` whose call of OMPL goes through OMPL's own Benchmark."""

from __future__ import annotations

import importlib
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import tools as ot

from apex_ompl import planners
from apex_ompl.api import load_problem
from apex_ompl.benchmark.rows import Job
from apex_ompl.errors import ApexError
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.report import Report
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.planning import Planning, solving_time
from apex_ompl.problems.generator import SuiteError
from apex_ompl.result import FIRST, PlanResult, PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.trajectory.smoothness import jerk
from apex_ompl.trajopt.path import path_length
from apex_ompl.util.threads import one_torch_thread

if TYPE_CHECKING:
    from apex_ompl.planners import Parameters

Run = dict[str, Any]
"""A run as it is stored, ready for JSON."""

MEMORY = 16_384.0  # that OMPL grants a run [MB]
UPDATES = 0.05  # between two looks at a planner's progress [s]
NO_PROBLEM, CRASH = "NO_PROBLEM", str(PlanStatus.CRASH)
WARM_UP = "wall/easy/800000"
PROOF = ("verify", "repair")

_robots: dict[str, Robot] = {}


class Benchmarked(Planning):
    """One call of ``plan`` whose planner runs in an experiment of ``ompl.tools.Benchmark``.

    The planner runs even where the straight line is a solution.

    Attributes:
        optimizing: Whether the planner goes on until its time is up; the length of its first path is not known then.
        beside: States that the experiment judged for itself.
        properties: OMPL's properties of the run.
        common: OMPL's parameters of the planner.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take what a call of ``plan`` takes."""
        super().__init__(*args, **kwargs)
        self.optimizing, self.beside = False, 0
        self.properties: dict[str, str] = {}
        self.common: dict[str, str] = {}

    def straight_line(self) -> NDArray[np.float64] | None:
        """Return None: the planner has to find it."""
        return None

    def run_ompl(self, planner: ob.Planner, parameters: Parameters, timeout: float) -> PlanStatus:
        """Run the planner, and return its status; faults of the checkers are raised."""
        check_counts, reports = self.ready.checker.check_counts, list[Report | None]()
        judged = [check_counts.states]

        def begin(_: ob.Planner) -> None:
            seed_ompl(self.blank.seed)  # the experiment itself has drawn and judged states by then
            judged.append(check_counts.states)

        def end(*_: object) -> None:  # behind it the experiment judges the path, and clears the planner
            judged.append(check_counts.states)
            reports.append(getattr(planner, "report", None))

        noticed, check = list[float](), self.ready.motion_validator.check
        if parameters.optimizing:
            self.ready.motion_validator.check = self._noticing(noticed)
        experiment = ot.Benchmark(self.ready.simple_setup, "run")
        experiment.addPlanner(planner)
        experiment.setPreRunEvent(begin)
        experiment.setPostRunEvent(end)
        request = ot.Request(solving_time(parameters, timeout), MEMORY, 1, UPDATES, False, False, False)
        try:
            experiment.benchmark(request)
        finally:
            self.ready.motion_validator.check = (
                check  # or it and OMPL's objects would keep each other, and all that was planned
            )
        self.raise_faults()
        self.beside = judged[1] - judged[0] + check_counts.states - judged[2]
        if reports[0] is not None:
            planner.report = reports[0]
        recorded = experiment.getRecordedExperimentData().planners[0]
        self.optimizing = parameters.optimizing
        self.properties, self.common = recorded.runs[0].to_dict(), recorded.common.to_dict()
        self.times["solve"] = float(self.properties["time REAL"])
        noticed += [moment for data in recorded.runsProgressData for moment in _solved_at(data)]
        if noticed:
            self.times[FIRST] = min(noticed)
        return ompl_status(self.properties)

    def proof_of_first(self) -> float:
        """Return how long it takes to prove the first path, or what comes of it in the end [s].

        The shortened path may need a repair where the path as it was found does not. Of planners that use all their
        time the first path is not known: the proof of the last one stands for its proof.
        """
        proof = {stage: self.times.get(stage, 0.0) for stage in PROOF}
        if "repair" not in self.times or self.optimizing or self.raw is None:
            return proof["verify"]
        begin = time.perf_counter()
        check = full_check(self.ready.checker, self._with_exact_ends(self.raw), self.ready.start, self.ready.goals)
        return time.perf_counter() - begin if check else sum(proof.values())

    def _noticing(self, noticed: list[float]) -> Callable[[NDArray[np.float64], NDArray[np.float64]], bool]:
        """Return a check whose first call when there is a path notes the time since the first call [s]."""
        check, definition = self.ready.motion_validator.check, self.ready.simple_setup.getProblemDefinition()
        begin = 0.0

        def watched(first: NDArray[np.float64], second: NDArray[np.float64]) -> bool:
            nonlocal begin
            begin = begin or time.perf_counter()
            if not noticed and definition.hasExactSolution():
                noticed.append(time.perf_counter() - begin)
            return check(first, second)

        return watched


def ompl_status(properties: Mapping[str, str]) -> PlanStatus:
    """Return what a planner itself said in the end, of OMPL's properties of a run."""
    return PlanStatus(ob.PlannerStatus.PlannerStatusType(int(properties["status ENUM"])).name)


def _solved_at(progress: Iterable[Mapping[str, str]]) -> Iterator[float]:
    """Yield the moments of a run at which the planner said that it had a path [s]."""
    for moment in progress:
        costs = (float(value) for name, value in moment.items() if name.startswith("best cost"))
        if any(math.isfinite(cost) for cost in costs):
            yield float(moment["time REAL"])


def run(job: Job) -> Run:
    """Return one run; one that fails in an unforeseen way is not solved, and says why.

    Raises:
        ApexError: A file, a parameter or a checkpoint is at fault.
    """
    about = told_of(job)
    try:
        return about | _outcome(job)
    except SuiteError as error:
        return about | unsolved(NO_PROBLEM, str(error))
    except ApexError:
        raise
    except Exception as error:
        return about | unsolved(CRASH, repr(error))


def told_of(job: Job) -> Run:
    """Return what is stored of a run before it is made."""
    return {**asdict(job), "params": dict(job.params), "key": job.key}


def unsolved(status: str, reason: str) -> Run:
    """Return what is said of a run without a result."""
    return {"status": status, "reason": reason, "solved": False, "by": "", "first": None, "total": None, "setup": None,
            "times": {}, "length": None, "raw_length": None, "jerk": None, "raw_jerk": None, "clearance": None,
            "checks": 0, "counts": {}, "properties": {}, "common": {}, "load": None}  # fmt: skip


def _outcome(job: Job) -> Run:
    started = time.perf_counter()
    parameters = planners.parameters(job.planner, **job.params)
    problem = load_problem(job.problem)
    if problem.robot not in _robots:
        _robots[problem.robot] = load_robot(problem.robot)
    with quiet_ompl(), one_torch_thread():
        seed_ompl(job.seed)
        ready = assemble(problem, _robots[problem.robot], seed=job.seed)
        planning = Benchmarked(ready, job.planner, job.seed, time.perf_counter() - started, ())
        result = planning.finish(started, planning.solve(parameters, job.timeout, job.simplify))
    return told(planning, result)


def told(planning: Benchmarked, result: PlanResult) -> Run:
    """Return what is stored of a run."""
    times, path, report = result.times, result.path if result else None, planning.report
    raw = None if planning.optimizing else planning.raw  # others go on behind their first path
    found = path is not None
    total = sum(times.get(stage, 0.0) for stage in ("solve", "simplify", *PROOF))
    first = times.get(FIRST, times.get("solve", 0.0))
    if report is None or not report.judged:  # what the planner found had still to be proved
        first += planning.proof_of_first()
    return {
        "status": str(result.status), "reason": result.reason, "solved": found, "by": result.solved_by,
        "first": first if found else None, "total": total, "setup": times.get("setup"), "times": dict(times),
        "length": result.length if path is not None else None,
        "raw_length": path_length(raw) if found and raw is not None else None,
        "jerk": jerk(path) if path is not None and path_length(path) > 0.0 else None,
        "raw_jerk": jerk(raw) if found and raw is not None and path_length(raw) > 0.0 else None,
        "clearance": result.clearance if path is not None and np.isfinite(result.clearance) else None,
        "checks": result.checks - planning.beside, "properties": planning.properties, "common": planning.common,
        "load": os.getloadavg()[0],
        "counts": {} if report is None else {
            "candidates": report.candidates, "proposals": report.proposed, "resamples": report.resampled,
            "repair steps": report.steps, "improvements": report.improved,
        },
    }  # fmt: skip


def _robot_of(problem: str) -> str:
    """Return the robot of a problem; that of the suites where no problem can be drawn."""
    try:
        return load_problem(problem).robot
    except SuiteError:
        return load_problem(WARM_UP).robot


def warm_up(jobs: Sequence[Job], modules: Sequence[str] = ()) -> dict[str, float]:
    """Load what runs of some rows need, and return the seconds that the first run of each took.

    Args:
        jobs: One of each row. Those on problems of another robot than ``WARM_UP`` are made as they are.
        modules: That are imported first, and register planners.
    """
    for module in modules:
        importlib.import_module(module)
    seconds = {}
    for job in jobs:
        begin = time.perf_counter()
        problem = WARM_UP if _robot_of(job.problem) == _robot_of(WARM_UP) else job.problem
        run(Job("warm-up", problem, job.label, job.planner, job.params, 0, job.timeout, job.simplify))
        seconds[job.label] = time.perf_counter() - begin
    return seconds
