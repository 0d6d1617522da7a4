"""Motions along paths, and how smooth and long they are; runs of planners and of models with these columns."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any

import numpy as np
from paper.realism import load, sample
from paper.rows import PACE

from apex_ompl.errors import ApexError
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run, columns
from apex_ompl.evaluation.runs import planned as planned_run
from apex_ompl.ompl.validity import FullCheck, full_check
from apex_ompl.paths.path import path_length
from apex_ompl.robot import Robot
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.types import Array


def smoothness(motion: Trajectory) -> dict[str, float]:
    """Return the duration of a motion [s], and the root mean square over time of its jerk, |d3q/dt3| [rad/s^3]."""
    changes, gaps = np.diff(motion.accelerations, axis=0), np.diff(motion.times)
    squares = float(((changes**2).sum(axis=1) / gaps).sum())
    return {"duration": motion.duration, "rms_jerk": float(np.sqrt(squares / motion.duration))}


def followed(path: Array, robot: Robot) -> dict[str, float | None]:
    """Return these numbers for the motion along a path, shape (N, dof), at ``PACE`` of the velocity limits.

    They are None where no motion follows the path within the limits, or where it has no length.
    """
    try:
        timed = time_path(path, robot.limits, robot.joint_names, Timing(velocity_scale=PACE))
        return dict(smoothness(timed.trajectory)) if path_length(path) > 0.0 else NO_MOTION
    except ApexError:
        return NO_MOTION


NO_MOTION: dict[str, float | None] = {"duration": None, "rms_jerk": None}


CUBE, ITSELF, LIMITS = "cube", "itself", "limits"
"""Causes of failures of a path: what it meets first, or that it leaves the limits."""


def cause(check: FullCheck, obstacles: Collection[str]) -> str:
    """Return what a path meets first: an obstacle, or the robot itself and what it holds; empty for a valid path.

    Args:
        check: The check of the path.
        obstacles: Names of the obstacles.
    """
    if check or check.proof is None:
        return "" if check else LIMITS
    return CUBE if set(check.proof.pair) & set(obstacles) else ITSELF


def one_sample(job: Job) -> Run:
    """Return the run of one path of a model for a problem: nothing is drawn again where it is invalid."""
    model = job.params["model"]
    ready, control, took = sample(model, job.params["gamma"], job)
    path = load(model).spline.path(control)
    check = full_check(ready.checker, path, ready.start, list(ready.goals))
    valid = bool(check)
    length = path_length(path) if valid else None
    motion = followed(path, ready.robot) if valid else NO_MOTION
    outcome = cause(check, [obstacle.name for obstacle in ready.problem.scene])
    return {
        "solved": valid, "outcome": outcome, "reason": check.reason, "total": took, "length": length,
        "raw_length": length, "cpu": took, **motion,
    }  # fmt: skip


def timed(job: Job) -> Run:
    """Return the run of a planner by OMPL's Benchmark, with the CPU time of all of it [s] and its motion."""
    begin = time.process_time()
    planning, experiment, result = planned_run(job)
    cpu = time.process_time() - begin
    found = result.path is not None and bool(result)
    motion = followed(result.path.states, planning.setup.robot) if found and result.path is not None else NO_MOTION
    made: dict[str, Any] = columns(planning, experiment, result)
    return made | {"cpu": cpu, **motion}
