"""Runs of benchmarks/model/constrained_model.py: a model's proposals alone, and the model in the planner.

Each function makes one run for ``apex_ompl.evaluation.bench``. Times are CPU times of the process, and so is the limit
of the planner.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from unittest import mock

import numpy as np
from ompl import base as ob

from apex_ompl import load_problem
from apex_ompl.apex import planner as apex_planner
from apex_ompl.apex.models import make_query
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.model.array_model import ArrayModel
from apex_ompl.ompl.own_planner import reporting
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.suite_robot import ROBOT, robot
from apex_ompl.types import Array
from benchmarks.model import constrained_told
from benchmarks.model.constrained_data import TOLD, paths_on, told, violations
from benchmarks.planners.head_to_head import TREELESS

PROPOSALS = 16
TEMPERATURES = (0.5, 1.0, 1.3)  # of raw proposals; the last one is that of the shipped model
LIMIT = 0.5  # CPU time of the planner [s]
LINE = "line"
WITHOUT_TREES = {**TREELESS, "polish": False}


@cache
def _loaded(folder: str) -> ArrayModel:
    return constrained_told.load(Path(folder), ROBOT)


@lru_cache(maxsize=1)
def _assembled(problem: str, seed: int) -> PlanningSetup:
    """Return a problem made ready, the last one from a cache: all rows run on a problem before the next one."""
    return assemble(load_problem(problem), robot(), seed)


def _prepared(job: Job) -> tuple[PlanningSetup, ArrayModel]:
    """Return the problem of a run and its model, which is told the constraints if it can be."""
    setup = _assembled(job.problem, job.seed)
    assert setup.constraints is not None
    model = _loaded(job.params["model"])
    constrained_told.tell(model, told(robot(), setup.constraints))
    return setup, model


def line(job: Job) -> Run:
    """Return whether the straight line, optimized under constraints, is a path."""
    setup = _assembled(job.problem, job.seed)
    paths, begun = paths_on(setup, Spline()), time.process_time()
    found = paths.repaired(paths.optimizer.spline.line(setup.start, setup.goals[0]))
    return {"solved": found is not None, "cpu": time.process_time() - begun, "fault": ""}


def proposed(job: Job) -> Run:
    """Return how far proposals are off the constraints, and which of them become paths when they are optimized.

    The parameter ``model`` is the folder of a checkpoint. ``first_cpu`` is the time until the first path is proved, all
    proposals being made before.
    """
    setup, model = _prepared(job)
    constraints, kernel, spline = setup.constraints, setup.checker.kernel, model.spline
    assert constraints is not None
    paths, first = paths_on(setup, spline), None
    begun = time.process_time()
    query = make_query(setup.checker, setup.start, setup.goals[0], point=model.sees_point)
    rng = np.random.default_rng([job.seed, int(job.problem.rpartition("/")[2])])
    control = model.propose(query, kernel, PROPOSALS, generator=rng).control
    at_proposals = time.process_time() - begun
    valid, lengths = list[bool](), list[float]()
    for points in control:
        found = paths.repaired(points)
        valid.append(found is not None)
        if found is not None:
            first = first or time.process_time() - begun
            lengths.append(float(np.linalg.norm(np.diff(found[1], axis=0), axis=1).sum()))
    cpu = time.process_time() - begun
    off = violations(constraints, np.stack([spline.path(points) for points in control]))
    return {
        "solved": any(valid), "on_first": valid[0], "valid": sum(valid) / len(valid), "first_cpu": first, "cpu": cpu,
        "proposals_cpu": at_proposals, "length": min(lengths, default=None), "distance": _listed(off.distance),
        "angle": _listed(off.angle), "tilt": _listed(off.tilt), "fault": "",
    }  # fmt: skip


def raw(job: Job) -> Run:
    """Return how far proposals are off the constraints, by temperature, and the straight line.

    Parameters are ``model``, the folder of a checkpoint, and ``told``: whether it is told the constraints, or zeros.
    """
    setup, model = _prepared(job)
    constraints, kernel, spline = setup.constraints, setup.checker.kernel, model.spline
    assert constraints is not None
    if not job.params["told"]:
        constrained_told.tell(model, np.zeros(TOLD))
    query = make_query(setup.checker, setup.start, setup.goals[0], point=model.sees_point)
    found: Run = {"solved": True, "fault": ""}
    for temperature in (None, *TEMPERATURES):
        if temperature is None:
            control = spline.line(setup.start, setup.goals[0])[None]
        else:
            sampling, rng = replace(model.sampling, temperature=temperature), np.random.default_rng(job.seed)
            control = model.propose(query, kernel, PROPOSALS, sampling=sampling, generator=rng).control
        off = violations(constraints, np.stack([spline.path(points) for points in control]))
        name = LINE if temperature is None else f"{temperature:g}"
        found[name] = [_listed(off.distance), _listed(off.angle), _listed(off.tilt)]
    return found


def _listed(values: Array) -> list[float]:
    """Return numbers for a file, none where they are NaN."""
    return [] if np.isnan(values).all() else values.tolist()


def planned(job: Job) -> Run:
    """Return a run of the planner ``apex`` for at most ``LIMIT`` seconds of CPU time.

    Parameters are ``model``, the folder of a checkpoint, and ``trees``: whether it has trees; without them its first
    path is its result.
    """
    setup, model = _prepared(job)
    parameters = ApexParameters(seed=job.seed, **({} if job.params["trees"] else WITHOUT_TREES))
    with mock.patch.object(apex_planner, "trajectory_model", lambda *_: model), quiet_ompl():
        planner = parameters.build(setup.simple_setup.getSpaceInformation())
        setup.simple_setup.getProblemDefinition().clearSolutionPaths()  # of other rows
        setup.simple_setup.setPlanner(planner)
        setup.simple_setup.setup()
    with mock.patch.object(time, "perf_counter", time.process_time), quiet_ompl():  # times of the report are CPU times
        begun = time.process_time()
        ends = ob.PlannerTerminationCondition(lambda: time.process_time() > begun + LIMIT)
        solved = bool(setup.simple_setup.solve(ends) == ob.PlannerStatus.EXACT_SOLUTION)
        cpu = time.process_time() - begun
    ours = reporting(planner)
    assert ours is not None
    report = ours.report
    found: Run = {"solved": False, "first_cpu": None, "cpu": cpu, "length": None, "by": report.solved_by, "fault": ""}
    if not solved or report.best_path is None:
        return found
    ends_of = setup.start, setup.valid_goals
    check = full_check(setup.checker, report.best_path.states, *ends_of, constraints=setup.constraints)
    fault = "" if check else check.reason
    return {
        **found,
        "solved": bool(check),
        "first_cpu": report.first,
        "length": report.best_path.length,
        "fault": fault,
    }
