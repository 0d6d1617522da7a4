"""One run of a benchmark: ``plan`` whose call of OMPL goes through OMPL's own Benchmark."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import tools as ot

from apex_ompl import planners
from apex_ompl.api import load_problem
from apex_ompl.assembly import assemble
from apex_ompl.benchmark.rows import Job
from apex_ompl.interrupt import Interrupt
from apex_ompl.metrics import jerk
from apex_ompl.ompl_globals import quiet_ompl, seed_ompl
from apex_ompl.planning import Planning, solving_time
from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.result import FIRST, PlanResult, PlanStatus
from apex_ompl.robot import Robot, load_robot
from apex_ompl.space import path_length, path_to_array
from apex_ompl.torch_threads import one_torch_thread

if TYPE_CHECKING:
    from apex_ompl.planners import Parameters

Run = dict[str, Any]
"""A run as it is stored, ready for JSON."""

MEMORY = 16_384.0  # that OMPL grants a run [MB]
LOOK = 0.005  # between two looks for a first path [s]
UPDATES = 0.05  # between two looks at a planner's progress [s]
NO_PROBLEM, CRASH = "NO_PROBLEM", str(PlanStatus.CRASH)
WARM_UP = "wall/easy/800000"
PROOF = ("verify", "repair")

_robots: dict[str, Robot] = {}


class Watch(threading.Thread):
    """Looks for a planner's first exact path while it runs, every few milliseconds.

    Attributes:
        path: The path, shape (N, dof), or None.
        seconds: From the beginning until it was seen.
        over: Set when there is nothing more to be seen.
    """

    def __init__(self, pdef: ob.ProblemDefinition, dof: int) -> None:
        """Watch a problem definition; ``start`` begins."""
        super().__init__(daemon=True)
        self._pdef, self._dof = pdef, dof
        self._begin = time.perf_counter()
        self.path: NDArray[np.float64] | None = None
        self.seconds = np.inf
        self.over = threading.Event()

    def start(self) -> None:
        """Begin."""
        self._begin = time.perf_counter()
        super().start()

    def run(self) -> None:
        """Look."""
        while not self.over.wait(LOOK):
            if self._pdef.hasExactSolution():
                self.seconds = time.perf_counter() - self._begin
                self.path = path_to_array(self._pdef.getSolutionPath(), self._dof)
                return


class Benchmarked(Planning):
    """One call of ``plan`` whose planner runs in an experiment of ``ompl.tools.Benchmark``.

    The planner runs even where the straight line is a solution.

    Attributes:
        first_path: Of planners that go on after their first path, that one, shape (N, dof), or None.
        properties: OMPL's properties of the run.
        common: OMPL's parameters of the planner.
        seed: Of OMPL's random numbers.
    """

    first_path: NDArray[np.float64] | None = None
    properties: dict[str, str]
    common: dict[str, str]
    seed: int

    def straight_line(self) -> NDArray[np.float64] | None:
        """Return None: the planner has to find it."""
        return None

    def run_ompl(self, planner: ob.Planner, parameters: Parameters, timeout: float) -> PlanStatus:
        """Run the planner, and return its status; faults of the checkers are raised."""
        said = []
        experiment = ot.Benchmark(self.ready.simple_setup, "run")
        experiment.addPlanner(planner)
        watch = Watch(self.ready.simple_setup.getProblemDefinition(), self.ready.robot.dof)

        def begin(_: ob.Planner) -> None:
            seed_ompl(self.seed)  # the experiment itself has drawn states by then
            if parameters.optimizing:
                watch.start()

        experiment.setPreRunEvent(begin)
        experiment.setPostRunEvent(
            lambda *_: said.append(getattr(planner, "report", None))
        )  # then it clears the planner
        request = ot.Request(solving_time(parameters, timeout), MEMORY, 1, UPDATES, False, False, False)
        try:
            experiment.benchmark(request)
        finally:
            watch.over.set()
        self.raise_faults()
        if said and said[0] is not None:
            planner.report = said[0]
        recorded = experiment.getRecordedExperimentData().planners[0]
        self.properties, self.common = recorded.runs[0].to_dict(), recorded.common.to_dict()
        self.times["solve"] = float(self.properties["time REAL"])
        if watch.path is not None:
            self.first_path, self.times[FIRST] = watch.path, min(watch.seconds, self.times["solve"])
        return PlanStatus(ob.PlannerStatus.PlannerStatusType(int(self.properties["status ENUM"])).name)


def run(job: Job) -> Run:
    """Return one run; one that fails in an unforeseen way is not solved, and says why.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; the run ended in good order first.
    """
    about = told_of(job)
    try:
        return about | _outcome(job)
    except SuiteError as error:
        return about | unsolved(NO_PROBLEM, str(error))
    except Exception as error:
        return about | unsolved(CRASH, repr(error))


def told_of(job: Job) -> Run:
    """Return what is stored of a run before it is made."""
    return {**asdict(job), "params": dict(job.params), "key": job.key}


def unsolved(status: str, reason: str) -> Run:
    """Return what is said of a run without a result."""
    return {"status": status, "reason": reason, "solved": False, "by": "", "first": None, "total": None, "setup": None,
            "times": {}, "length": None, "raw_length": None, "jerk": None, "raw_jerk": None, "clearance": None,
            "checks": 0, "counts": {}, "properties": {}, "common": {}}  # fmt: skip


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
        planning.seed, planning.properties, planning.common = job.seed, {}, {}
        with Interrupt() as planning.interrupt:
            result = planning.solve(parameters, job.timeout, job.simplify)
        result = planning.finish(started, result)
    return told(planning, result)


def told(planning: Benchmarked, result: PlanResult) -> Run:
    """Return what is stored of a run."""
    times, path, report = result.times, result.path if result else None, planning.report
    raw = planning.raw if planning.first_path is None else planning.first_path
    found = raw is not None and bool(result)
    total = sum(times.get(stage, 0.0) for stage in ("solve", "simplify", *PROOF))
    first = times.get(FIRST, times.get("solve", 0.0))
    if report is None or not report.judged:  # what the planner found had still to be proved
        first += sum(times.get(stage, 0.0) for stage in PROOF)
    return {
        "status": str(result.status), "reason": result.reason, "solved": bool(result), "by": result.solved_by,
        "first": first if found else None, "total": total, "setup": times.get("setup"), "times": dict(times),
        "length": result.length if path is not None else None,
        "raw_length": path_length(raw) if found and raw is not None else None,
        "jerk": jerk(path) if path is not None and path_length(path) > 0.0 else None,
        "raw_jerk": jerk(raw) if found and raw is not None and path_length(raw) > 0.0 else None,
        "clearance": result.clearance if path is not None and np.isfinite(result.clearance) else None,
        "checks": result.checks, "properties": planning.properties, "common": planning.common,
        "counts": {} if report is None else {
            "candidates": report.candidates, "proposals": report.proposed, "resamples": report.resampled,
            "repair steps": report.steps, "improvements": report.improved,
        },
    }  # fmt: skip


def warm_up(jobs: Sequence[Job], modules: Sequence[str] = ()) -> dict[str, float]:
    """Load what runs of some rows need, and return the seconds that the first run of each took.

    Args:
        jobs: One of each row.
        modules: That are imported first, and register planners.
    """
    for module in modules:
        importlib.import_module(module)
    seconds = {}
    for job in jobs:
        begin = time.perf_counter()
        run(Job("warm-up", WARM_UP, job.label, job.planner, job.params, 0, job.timeout, job.simplify))
        seconds[job.label] = time.perf_counter() - begin
    return seconds
