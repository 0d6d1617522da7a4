"""Timed motion of a path, and what is measured of a result in the end."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from apex_ompl.errors import TimingError, TimingStoppedError
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.planning.run import PlanRun
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.trajectory import Timing, Trajectory, time_path
from apex_ompl.trajectory.trajectory import ROUNDING
from apex_ompl.trajopt.path import resample
from apex_ompl.util.resolution import MOTION_RESOLUTION
from apex_ompl.util.stopwatch import timed

CLEARANCE_SAMPLES = 32
CHORD = 1e-5  # largest distance of a timed motion from the straight line between two states that are checked [rad]
MAX_STATES = 100_000  # of a timed motion that are checked
NOT_TIMED = "a path was found but not timed in time"


def parameterize(run: PlanRun, result: PlanResult, timing: Timing) -> PlanResult:
    """Return a result with its path timed, or with the status TIMEOUT or TIMING_FAILED.

    The motion keeps the limits and passes its own proof.

    Args:
        run: The call of ``plan``.
        result: Result whose path passed the full check; without one it is returned as it is.
        timing: How the path is timed.
    """
    if result.path is None or not result:
        return result
    limits, names, proof = run.setup.robot.limits, run.setup.robot.joint_names, dict[str, float]()

    def fault(motion: Trajectory) -> str:
        with timed(proof, "motion"):
            shares = motion.use(timing.limits(limits))
            over = [f"{name} {share:.4f}" for name, share in shares.items() if share > 1.0 + ROUNDING]
            if over:
                return f"the share of a limit that it uses is over 1: {', '.join(over)}"
            return motion_fault(run, motion, run.deadline.at)

    def stop() -> bool:
        return run.interrupt.pressed or run.deadline.expired

    try:
        with timed(run.times, "timing"):
            made = time_path(result.path, limits, names, timing, fault, stop=stop)
    except TimingStoppedError:
        return replace(result, status=PlanStatus.TIMEOUT, reason=NOT_TIMED)
    except TimingError as error:
        return replace(result, status=PlanStatus.TIMING_FAILED, reason=f"the path cannot be timed, {error}")
    finally:
        run.times["timing"] -= proof.get("motion", 0.0)
        run.times["timing proof"] = proof.get("motion", 0.0)
    motion = made.trajectory
    return replace(
        result, trajectory=motion, limit_use=motion.use(limits), deviation=made.deviation,
        timing_resolution=MOTION_RESOLUTION,
    )  # fmt: skip


def motion_fault(run: PlanRun, motion: Trajectory, deadline: float) -> str:
    """Return why a timed motion is no solution, empty where it is.

    Args:
        run: The call of ``plan``.
        motion: The motion.
        deadline: Value of ``time.perf_counter`` at which its proof gives up [s].
    """
    setup, limits = run.setup, run.setup.robot.limits
    acceleration = max(float(np.abs(motion.accelerations).max()), 1e-9)
    spacing = max(np.sqrt(8.0 * CHORD / acceleration), motion.duration / MAX_STATES, 1e-6)
    states = np.clip(motion.sample(spacing).position, limits.lower, limits.upper)  # without rounding
    return full_check(setup.checker, states, setup.start, setup.goals, MOTION_RESOLUTION, deadline=deadline).reason


def finish(run: PlanRun, result: PlanResult, started: float) -> PlanResult:
    """Add clearance, length, counts and times.

    Args:
        run: The call of ``plan``.
        result: What came of it.
        started: Value of ``time.perf_counter`` when the call began [s].
    """
    checks = run.setup.checker.check_counts.states
    if result.path is not None:
        with timed(run.times, "clearance"):
            states = resample(result.path.states, CLEARANCE_SAMPLES)
            clearance = min(run.setup.checker.clearance(q) for q in states)
        result = replace(result, length=result.path.length, clearance=clearance)
    run.times["total"] = time.perf_counter() - started
    return replace(result, checks=checks, times=dict(run.times))
