"""What ``plan`` does with a problem that is made ready: line, planner, shortening, proof, repair."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from ompl import base as ob

from apex_ompl.errors import ApexError, TimingError
from apex_ompl.ompl_adapter.interrupt import Interrupt
from apex_ompl.ompl_adapter.repair import repair
from apex_ompl.ompl_adapter.setup import PlanningSetup, set_goals
from apex_ompl.ompl_adapter.simplify import simplify as shorten
from apex_ompl.ompl_adapter.space import path_to_array
from apex_ompl.ompl_adapter.validity import FullCheck, full_check
from apex_ompl.result import FIRST, INSIDE, PlanResult, PlanStatus
from apex_ompl.trajectory import Timing, Trajectory, time_path
from apex_ompl.trajectory.trajectory import ROUNDING
from apex_ompl.trajopt.path import path_length, resample
from apex_ompl.types import Array
from apex_ompl.util.resolution import FULL_RESOLUTION, MOTION_RESOLUTION
from apex_ompl.util.stopwatch import timed

if TYPE_CHECKING:
    from apex_ompl.ompl_adapter.report import Report
    from apex_ompl.planners import Parameters


CLEARANCE_SAMPLES = 32
CHORD = 1e-5  # largest distance of a timed motion from the straight line between two states that are checked [rad]
MOST_STATES = 100_000  # of a timed motion that are checked
STRAIGHT_LINE = "straight line"
LONGEST_FINE_REPAIR = 3.0  # of a path that fails the check at MOTION_RESOLUTION, on top of the timeout [s]
PROOF_SHARE, LONGEST_PROOF = 0.1, 0.5  # time kept from planners that stop at the timeout only, for repair [1, s]
LONGEST_TIMEOUT = 1e8  # OMPL counts nanoseconds in 64 bits [s]


class Planning:
    """One call of ``plan`` on an assembled problem.

    Attributes:
        ready: The problem.
        interrupt: Holds Ctrl-C back.
        times: Seconds per stage so far.
        blank: The result before anything is known.
        raw: The first path that the planner found, shape (N, dof), or None.
        report: What the planner says of its call of ``solve``, of planners that say it.
    """

    def __init__(
        self, ready: PlanningSetup, planner: str, seed: int, setup_time: float, notes: tuple[str, ...]
    ) -> None:
        """Plan for ``ready`` with a planner by its name; ``setup_time`` went by already [s]."""
        self.ready = ready
        self.planner = planner
        self.interrupt = Interrupt()
        self.times = {"setup": setup_time}
        self.raw: Array | None = None
        self.report: Report | None = None
        self.blank = PlanResult(
            status=PlanStatus.UNKNOWN, reason="", problem=ready.problem, robot=ready.robot.name,
            joint_names=ready.robot.joint_names, planner=planner, seed=seed, notes=notes,
        )  # fmt: skip

    def solve(self, parameters: Parameters, timeout: float, simplify: bool) -> PlanResult:
        """Return the result without what ``finish`` adds."""
        ready = self.ready
        if ready.start_fault:
            return self._failed(PlanStatus.INVALID_START, ready.start_fault)
        if all(ready.goal_faults):
            return self._failed(PlanStatus.INVALID_GOAL, "; ".join(ready.goal_faults))
        with timed(self.times, "line"):
            line = self.straight_line()
        if line is not None:
            return self._exact(line, STRAIGHT_LINE)
        try:
            with timed(self.times, "setup"):
                planner = self._set_up(parameters)
            status = self.run_ompl(planner, parameters, timeout)
            deadline = time.perf_counter() + timeout - self.times["solve"]
            report = self.report = getattr(planner, "report", None)
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
            self.raw = states if report is None or report.path is None else report.path
            solved_by = self.planner if report is None else report.solved_by
            return self._proved(states, deadline, simplify and not parameters.smooth, solved_by)
        except ApexError:  # a checkpoint that is missing, for one
            raise
        except Exception as error:
            return self._failed(PlanStatus.CRASH, f"{self.planner} failed, {error!r}")

    def straight_line(self) -> Array | None:
        """Return the straight line to the nearest goal for which it is a solution, or None.

        Some of OMPL's planners hang, give up or raise where there is nothing to search for.
        """
        ready = self.ready
        goals = sorted(ready.valid_goals, key=lambda goal: float(np.linalg.norm(goal - ready.start)))
        lines = (np.stack([ready.start, goal]) for goal in goals)
        free = (line for line in lines if ready.checker.first_collision(line, FULL_RESOLUTION) is None)
        return next((line for line in free if full_check(ready.checker, line, ready.start, goals)), None)

    def _set_up(self, parameters: Parameters) -> ob.Planner:
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

    def run_ompl(self, planner: ob.Planner, parameters: Parameters, timeout: float) -> PlanStatus:
        """Run the planner, which is set, and return its status; faults of the checkers are raised."""
        del planner
        # A condition made in C++: planners that run threads deadlock with one made in Python.
        condition = ob.timedPlannerTerminationCondition(solving_time(parameters, timeout))
        with self.interrupt.ends(condition) as ptc, timed(self.times, "solve"):
            status = PlanStatus.of(self.ready.simple_setup.solve(ptc))
        self.raise_faults()
        return status

    def raise_faults(self) -> None:
        """Raise what the checkers met inside of OMPL."""
        fault = self.ready.validity_checker.fault or self.ready.motion_validator.fault
        if fault is not None:
            raise fault

    def with_timing(self, result: PlanResult, timing: Timing) -> PlanResult:
        """Return a result with its path timed, or with the status TIMING_FAILED.

        Stretches of the path that fail the full check at MOTION_RESOLUTION are planned anew, since motions along them
        would fail it too. The motion is valid when it keeps the limits and passes that check.
        """
        path, proof = result.path, dict[str, float]()
        if path is None or not result:
            return result
        ready, limits, names = self.ready, self.ready.robot.limits, self.ready.robot.joint_names

        def fault(motion: Trajectory) -> str:
            with timed(proof, "motion"):
                shares = motion.use(timing.limits(limits))
                over = [f"{name} {share:.4f}" for name, share in shares.items() if share > 1.0 + ROUNDING]
                if over:
                    return f"the share of a limit that it uses is over 1: {', '.join(over)}"
                acceleration = max(float(np.abs(motion.accelerations).max()), 1e-9)
                spacing = max(np.sqrt(8.0 * CHORD / acceleration), motion.duration / MOST_STATES, 1e-6)
                states = np.clip(motion.sample(spacing).position, limits.lower, limits.upper)  # without rounding
                return full_check(ready.checker, states, ready.start, ready.goals, MOTION_RESOLUTION).reason

        with timed(proof, "path"):
            check = full_check(ready.checker, path, ready.start, ready.goals, MOTION_RESOLUTION)
        if not check:
            with timed(self.times, "repair"):
                repaired = self._repaired_finely(path, check)
            if repaired is not None:
                path, solved_by = repaired, f"{result.solved_by.removesuffix('+repair')}+repair"
                result = replace(result, path=path, solved_by=solved_by)
        try:
            with timed(self.times, "timing"):
                made = time_path(path, limits, names, timing, fault)
        except TimingError as error:
            return replace(result, status=PlanStatus.TIMING_FAILED, reason=f"the path cannot be timed, {error}")
        finally:
            self.times["timing"] -= proof.get("motion", 0.0)
            self.times["timing proof"] = sum(proof.values())
        motion = made.trajectory
        return replace(
            result, trajectory=motion, limit_use=motion.use(limits), deviation=made.deviation,
            timing_resolution=MOTION_RESOLUTION,
        )  # fmt: skip

    def _repaired_finely(self, path: Array, check: FullCheck) -> Array | None:
        """Return a path that passes the full check at MOTION_RESOLUTION, or None; ``check`` is the one it failed."""
        deadline = time.perf_counter() + LONGEST_FINE_REPAIR
        return repair(self.ready, path, check, deadline, self.interrupt, resolution=MOTION_RESOLUTION)

    def finish(self, started: float, result: PlanResult) -> PlanResult:
        """Add clearance, length, counts and times."""
        path = result.path
        checks = self.ready.checker.check_counts.states
        if path is not None:
            with timed(self.times, "clearance"):
                states = resample(path, CLEARANCE_SAMPLES)
                clearance = min(self.ready.checker.clearance(q) for q in states)
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
            self.raise_faults()
        ready, reason = self.ready, ""
        for candidate in candidates:
            with timed(self.times, "verify"):
                check = full_check(ready.checker, candidate, ready.start, ready.goals)
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
        check = full_check(ready.checker, path, ready.start)
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


def solving_time(parameters: Parameters, timeout: float) -> float:
    """Return how much of a timeout is for the planner [s]; what it finds must still be proved.

    Planners that stop at the timeout only leave a tenth of it, at most half a second.
    """
    if parameters.optimizing:
        timeout -= min(PROOF_SHARE * timeout, LONGEST_PROOF)
    return min(timeout, LONGEST_TIMEOUT)
