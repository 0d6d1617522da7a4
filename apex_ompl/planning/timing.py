"""Timed motion of a path, and what is measured of a result in the end."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from apex_ompl.errors import TimingError
from apex_ompl.ompl_adapter.repair import repair
from apex_ompl.ompl_adapter.validity import FullCheck, full_check
from apex_ompl.planning.run import PlanRun
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.trajectory import Timing, Trajectory, time_path
from apex_ompl.trajectory.trajectory import ROUNDING
from apex_ompl.trajopt.path import Path, resample
from apex_ompl.types import Array
from apex_ompl.util.resolution import MOTION_RESOLUTION
from apex_ompl.util.stopwatch import timed

CLEARANCE_SAMPLES = 32
CHORD = 1e-5  # largest distance of a timed motion from the straight line between two states that are checked [rad]
MAX_STATES = 100_000  # of a timed motion that are checked
MAX_FINE_REPAIR = 3.0  # of a path that fails the check at MOTION_RESOLUTION, on top of the timeout [s]


def parameterize(run: PlanRun, result: PlanResult, timing: Timing) -> PlanResult:
    """Return a result with its path timed, or with the status TIMING_FAILED.

    Stretches of the path that fail the full check at MOTION_RESOLUTION are planned anew, since motions along them would
    fail it too. The motion is valid when it keeps the limits and passes that check.
    """
    if result.path is None or not result:
        return result
    setup, limits, proof = run.setup, run.setup.robot.limits, dict[str, float]()

    def fault(motion: Trajectory) -> str:
        with timed(proof, "motion"):
            shares = motion.use(timing.limits(limits))
            over = [f"{name} {share:.4f}" for name, share in shares.items() if share > 1.0 + ROUNDING]
            if over:
                return f"the share of a limit that it uses is over 1: {', '.join(over)}"
            acceleration = max(float(np.abs(motion.accelerations).max()), 1e-9)
            spacing = max(np.sqrt(8.0 * CHORD / acceleration), motion.duration / MAX_STATES, 1e-6)
            states = np.clip(motion.sample(spacing).position, limits.lower, limits.upper)  # without rounding
            return full_check(setup.checker, states, setup.start, setup.goals, MOTION_RESOLUTION).reason

    with timed(proof, "path"):
        check = full_check(setup.checker, result.path.states, setup.start, setup.goals, MOTION_RESOLUTION)
    try:
        if not check:
            result = _repaired_finely(run, result, result.path.states, check)
        assert result.path is not None
        with timed(run.times, "timing"):
            made = time_path(result.path, limits, setup.robot.joint_names, timing, fault)
    except TimingError as error:
        return replace(result, status=PlanStatus.TIMING_FAILED, reason=f"the path cannot be timed, {error}")
    finally:
        run.times["timing"] = run.times.get("timing", 0.0) - proof.get("motion", 0.0)
        run.times["timing proof"] = sum(proof.values())
    motion = made.trajectory
    return replace(
        result, trajectory=motion, limit_use=motion.use(limits), deviation=made.deviation,
        timing_resolution=MOTION_RESOLUTION,
    )  # fmt: skip


def _repaired_finely(run: PlanRun, result: PlanResult, states: Array, check: FullCheck) -> PlanResult:
    """Return a result whose path passes the full check at MOTION_RESOLUTION.

    Raises:
        TimingError: No such path is found.
    """
    with timed(run.times, "repair"):
        deadline = time.perf_counter() + MAX_FINE_REPAIR
        repaired = repair(run.setup, states, check, deadline, run.interrupt, resolution=MOTION_RESOLUTION)
    if repaired is None:
        raise TimingError(f"it fails the full check at {MOTION_RESOLUTION:g} rad, {check.reason}")
    return replace(result, path=Path(repaired), solved_by=f"{result.solved_by.removesuffix('+repair')}+repair")


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
