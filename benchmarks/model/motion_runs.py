"""Runs of benchmarks/model/motion_model.py: a model in the planner without trees, and its proposals alone.

Each function makes one run for ``apex_ompl.evaluation.bench``. Times are CPU times of the process.
"""

from __future__ import annotations

import time
from unittest import mock

import numpy as np

from apex_ompl import load_problem
from apex_ompl.apex.models import make_query, trajectory_model
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.planning import motions
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Timing
from apex_ompl.timing.duration import LEVELS, MOST_SPANS, RAMPS, DurationOptimizer
from apex_ompl.timing.timed_spline import Start, TimedSpline
from apex_ompl.types import Array
from benchmarks.model.motion_data import proved, states_in_time
from benchmarks.planners.head_to_head import TREELESS
from benchmarks.timing.motion_rows import called, columns_of, lower_bound

ALONE, REPAIRED = 2, 4  # proposals of a run without repair, and with it
LEAST_SPANS = 8
AS_PATH, AS_MOTION = "path", "motion"


class MotionOptimizer(DurationOptimizer):
    """Optimizes from the states of a motion, evenly spaced in time, where its base class takes those of a path."""

    def _guess(self, states: Array) -> TimedSpline | None:
        """Return the motion through the states, with as many knots as the base class gives their path."""
        rates = (np.abs(np.diff(states, axis=0)) / self.limits.velocity).max(axis=1)
        duration = float(rates.sum()) + RAMPS
        spans = int(np.clip(round(LEVELS[0].rate * duration), LEAST_SPANS, MOST_SPANS // 6))
        return TimedSpline.along(states, duration, Start.at_rest(states[0]), states[-1], spans)


def planned(job: Job) -> Run:
    """Return a run of ``plan`` by apex without trees and with the objective ``time``.

    Parameters are ``model``, a checkpoint, and ``other_paths``: whether the step that makes the motion tries paths of
    trees of its own where the motion takes long, as it does by default.
    """
    problem = load_problem(job.problem)
    setup = assemble(problem, robot(), job.seed)  # makes what all calls in this process reuse, such as covers of meshes
    params = {**TREELESS, "model": job.params["model"]}
    with mock.patch.object(motions, "WAYS", motions.WAYS if job.params["other_paths"] else 0):
        call = called(problem, "apex", params=params, timeout=job.timeout, seed=job.seed, objective="time")
    return columns_of(call, setup, Timing())


def proposed(job: Job) -> Run:
    """Return the motions that the duration optimizer makes of a model's proposals, without shortening paths before.

    Parameters are ``model``, a checkpoint; ``taken_as``: proposals are a ``path``, to which the optimizer gives a first
    timing, or a ``motion`` whose timing it starts from; and ``repaired``: whether they are repaired as the planner does
    until one is free, and only that one is taken.
    """
    setup, taken_as = assemble(load_problem(job.problem), robot(), job.seed), job.params["taken_as"]
    kernel, start, goal = setup.checker.kernel, setup.start, setup.goals[0]
    model = trajectory_model(job.params["model"], setup.robot)
    optimizer = (MotionOptimizer if taken_as == AS_MOTION else DurationOptimizer)(kernel, setup.robot.limits)
    found, first, begun = list[float](), None, time.process_time()
    query = make_query(setup.checker, start, goal, point=model.sees_point)
    with model.one_thread():
        generator = np.random.default_rng(job.seed)
        count = REPAIRED if job.params["repaired"] else ALONE
        control = model.propose(query, kernel, count, generator=generator).control
    at_proposals = time.process_time() - begun
    for points in repaired(setup, control) if job.params["repaired"] else control:
        states = states_in_time(points, model.spline) if taken_as == AS_MOTION else model.spline.path(points)
        states[0], states[-1] = start, goal
        motion = proved(setup, optimizer, states, goal)
        if motion is not None:
            first = first or time.process_time() - begun
            found.append(motion.duration)
    return {
        "solved": bool(found), "free": len(found), "durations": found, "duration": min(found, default=None),
        "direct": lower_bound(setup), "first_cpu": first, "proposals_cpu": at_proposals,
        "cpu": time.process_time() - begun, "fault": "",
    }  # fmt: skip


def repaired(setup: PlanningSetup, control: Array) -> Array:
    """Return the first of some paths that is free after repair, control points of shape (1 or 0, points, dof)."""

    def is_valid(path: Array) -> bool:
        return bool(full_check(setup.checker, path, setup.start, [setup.goals[0]]))

    found = first_valid(Optimizer(), setup.checker.kernel, control, is_valid)
    return control[:0] if found is None else found[None]
