"""Timed motion of a path, and what is measured of a result in the end."""

from __future__ import annotations

import time
from dataclasses import replace
from math import nan

from apex_ompl.errors import TimingError, TimingStoppedError
from apex_ompl.ompl.validity import FullCheck, full_check
from apex_ompl.planning.run import PlanRun
from apex_ompl.result import PlanResult, PlanStatus
from apex_ompl.timing import Timing, Trajectory, time_path
from apex_ompl.timing.trajectory import ROUNDING
from apex_ompl.util.clocks import timed

NOT_TIMED = "a path was found but not timed in time"


def parameterize(run: PlanRun, result: PlanResult, timing: Timing) -> PlanResult:
    """Return a result with its path timed, or with the status TIMEOUT or TIMING_FAILED.

    The motion keeps the limits and is proved free along its own cubic pieces.

    Args:
        run: The call of ``plan``.
        result: Result whose path passed the full check; without one it is returned as it is.
        timing: How the path is timed.
    """
    if result.path is None or not result:
        return result
    setup, limits, names = run.setup, run.setup.robot.limits, run.setup.robot.joint_names
    proof, found = dict[str, float](), list[FullCheck]()

    def fault(motion: Trajectory) -> str:
        with timed(proof, "motion"):
            shares = motion.use(timing.limits(limits, names))
            over = [f"{name} {share:.4f}" for name, share in shares.items() if share > 1.0 + ROUNDING]
            if over:
                return f"the share of a limit that it uses is over 1: {', '.join(over)}"
            check = full_check(setup.checker, motion, setup.start, setup.goals, deadline=run.deadline.at)
            found.append(check)
            return check.reason

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
        result, trajectory=motion, limit_use=motion.use(limits), deviation=made.deviation, timing_method=made.method,
        motion_clearance=nan if found[-1].proof is None else found[-1].proof.clearance,
    )  # fmt: skip


def finish(run: PlanRun, result: PlanResult, started: float) -> PlanResult:
    """Add length, counts and times.

    Args:
        run: The call of ``plan``.
        result: What came of it.
        started: Value of ``time.perf_counter`` when the call began [s].
    """
    checks = run.setup.checker.check_counts.states
    if result.path is not None:
        result = replace(result, length=result.path.length)
    run.times["total"] = time.perf_counter() - started
    return replace(result, checks=checks, times=dict(run.times))
