"""Multi-start search for the fastest motion of a problem, the reference of benchmarks/timing/motions.py.

Paths come from apex and from tuned rrtconnect with further seeds, from straight lines through one or two random free
states, and from the best motion so far, moved at random or led through a random free state. Each is the start of
:class:`apex_ompl.timing.duration.DurationOptimizer`; each motion that is nearly as fast as the best is optimized again
with more knots, which bring the jerk to its limit, and with smaller margins. The fastest motion that passes the full
check counts. Before all that, Ruckig's motion from rest to rest in the lower bound is checked. The search takes a time
of CPU, and ends early where the lower bound is reached.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from apex_ompl import load_problem, plan
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.kernel.duration import DurationSettings, TimeGrid, lower_duration
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import resample
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Problem
from apex_ompl.timing import Trajectory
from apex_ompl.timing.duration import DurationOptimizer
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import PINNED, TimedSpline, basis
from apex_ompl.types import Array
from benchmarks.timing.motion_figures import motion_fault
from benchmarks.timing.motion_rows import direct_motion, lower_bound

MARGINS = (0.001, 0.0002)  # least clearances [m]
FINER = (4, 2)  # multiples of the number of knots, until a motion is proved
NEARLY = 1.05  # of the best duration
SAMPLES, STEPS, HORIZON, TOLERANCE = 2, 60, 0.02, 2e-3  # of the optimization with more knots
REPAIRS = 2
CLOSE = 1.0005  # of the lower bound: it counts as reached
STATES = 129  # of the best motion, where it is moved
SPREADS = (0.3, 0.6, 1.0)  # of random states around the straight line [rad]
SHIFTS = (0.05, 0.8)  # least and largest size of a random movement of the best motion [rad]
ATTEMPTS = 100  # for a random free state
PLAN_TIMEOUT = 5.0  # [s]
FURTHER = 1000  # first seed of the plans, after the one of the run
WARM_UP, WARM_UP_SECONDS = "warm-up", 0.5


class MotionSearch:
    """Search for the fastest motion of a problem.

    Attributes:
        best: Fastest proved motion, or None.
        how: Kind of the path that gave it, and the number of knots and the margin where they were changed.
        history: CPU time and duration of each improvement [s].
        tried: Number of paths that were optimized, by kind.
    """

    def __init__(self, problem: Problem, setup: PlanningSetup, seed: int) -> None:
        """Search among the obstacles of ``setup``."""
        self.problem, self.setup, self.seed = problem, setup, seed
        self.rng = np.random.default_rng(seed)
        self.best: Trajectory | None = None
        self.how = ""
        self.history = list[tuple[float, float]]()
        self.tried: dict[str, int] = {}
        self._plans, self._started = 0, 0.0
        self._optimizer = DurationOptimizer(setup.checker.kernel, setup.robot.limits)

    def run(self, seconds: float) -> None:
        """Search for a time of CPU [s]."""
        self._started, bound = time.process_time(), lower_bound(self.setup)
        for goal in self.setup.valid_goals:
            self._keep(direct_motion(self.setup, goal), "direct")
        kinds: dict[str, Callable[[], Array | None]] = {
            "line": self._line, "apex": self._apex, "rrtconnect": self._rrtconnect, "one state": self._through_one,
            "two states": self._through_two, "moved": self._moved, "led": self._led,
        }  # fmt: skip
        names = list(kinds)
        kind = "line"
        while self._spent() < seconds and not (self.best is not None and self.best.duration <= CLOSE * bound):
            path = kinds[kind]()
            if path is not None:
                self.tried[kind] = self.tried.get(kind, 0) + 1
                self._optimize(path, kind)
            kind = names[1 + self._plans % 2] if self.best is None else str(self.rng.choice(names[1:]))

    def _spent(self) -> float:
        return time.process_time() - self._started

    def _optimize(self, path: Array, kind: str) -> None:
        """Optimize a path, and again with more knots where the motion is nearly as fast as the best so far."""
        spline: TimedSpline | None = self._optimizer.fastest(path)
        for turn in range(1, REPAIRS + 2):
            if spline is None:
                return
            if self._keep(spline.trajectory(self.setup.robot.joint_names), kind):
                break
            spline = self._optimizer.cleared(spline, turn) if turn <= REPAIRS else None
        if spline is not None and self.best is not None and spline.duration < NEARLY * self.best.duration:
            for margin in MARGINS:
                for times in FINER:
                    finer = self._finer(spline, times, margin).trajectory(self.setup.robot.joint_names)
                    if self._keep(finer, f"{kind}, {times} times the knots, {1e3 * margin:g} mm"):
                        break

    def _finer(self, spline: TimedSpline, times: int, margin: float) -> TimedSpline:
        """Return a motion with more knots and another margin [m], its duration lowered."""
        limits, control = self.setup.robot.limits, spline.refitted(times * spline.spans).control.copy(order="C")
        control[PINNED:-PINNED] = control[PINNED:-PINNED].clip(limits.lower, limits.upper)
        bounds = np.stack([limits.velocity, limits.acceleration, limits.jerk])
        settings = DurationSettings(margin, HORIZON, 1e-3, 5e-6, 0.3, 0.25, TOLERANCE, 1.0, 0.0, STEPS)
        grid = TimeGrid.of(len(control), SAMPLES, basis((np.arange(SAMPLES) + 0.5) / SAMPLES))
        spacing = 1.003 * least_knot_spacing(control, limits)
        lower_duration(self.setup.checker.kernel, grid, bounds, PINNED, control, spacing, settings)
        return TimedSpline(control, least_knot_spacing(control, limits) * (1.0 + 1e-9), spline.start)

    def _keep(self, motion: Trajectory, how: str) -> bool:
        """Keep a motion that is faster than the best, and return whether it needs no repair."""
        if self.best is not None and motion.duration >= self.best.duration:
            return True
        if motion_fault(self.setup, motion, self.setup.robot.limits):
            return False
        self.best, self.how = motion, how
        self.history.append((self._spent(), motion.duration))
        return True

    def _goal(self) -> Array:
        return np.asarray(self.rng.choice(self.setup.valid_goals))

    def _line(self) -> Array:
        return np.stack([self.setup.start, self._goal()])

    def _plan_seed(self) -> int:
        self._plans += 1
        return self.seed if self._plans == 1 else FURTHER * (self.seed + 1) + self._plans

    def _apex(self) -> Array | None:
        result = plan(self.problem, "apex", timeout=PLAN_TIMEOUT, seed=self._plan_seed())
        if result.trajectory is not None:
            self._keep(result.trajectory, "apex, as planned")
        return result.path.states if result and result.path is not None else None

    def _rrtconnect(self) -> Array | None:
        params, seed = TUNED["rrtconnect"], self._plan_seed()
        result = plan(self.problem, "rrtconnect", params=params, timeout=PLAN_TIMEOUT, seed=seed, timing=False)
        return result.path.states if result and result.path is not None else None

    def _free_state(self, around: Array) -> Array | None:
        limits, spread = self.setup.robot.limits, float(self.rng.choice(SPREADS))
        for _ in range(ATTEMPTS):
            q = np.clip(around + self.rng.normal(0.0, spread, around.shape), limits.lower, limits.upper)
            if self.setup.checker.is_free(q):
                return np.asarray(q)
        return None

    def _through(self, shares: Array) -> Array | None:
        start, goal = self._line()
        states = [self._free_state(start + share * (goal - start)) for share in np.sort(shares)]
        inner = [q for q in states if q is not None]
        return np.stack([start, *inner, goal]) if len(inner) == len(states) else None

    def _through_one(self) -> Array | None:
        return self._through(self.rng.uniform(0.2, 0.8, 1))

    def _through_two(self) -> Array | None:
        return self._through(self.rng.uniform(0.1, 0.9, 2))

    def _moved(self) -> Array | None:
        """Return the best motion's path with a smooth random perturbation."""
        if self.best is None:
            return None
        states = resample(self.best(np.linspace(0.0, self.best.duration, STATES)), STATES)
        s = np.linspace(0.0, 1.0, STATES)
        shape = 4.0 * s * (1.0 - s) * np.exp(-(((s - self.rng.random()) / self.rng.uniform(0.1, 0.5)) ** 2))
        size = np.exp(self.rng.uniform(*np.log(SHIFTS)))
        limits, largest = self.setup.robot.limits, self.rng.normal(0.0, size, states.shape[1])
        return np.clip(states + shape[:, None] * largest, limits.lower, limits.upper)

    def _led(self) -> Array | None:
        """Return the best motion's path with a random free state in place of a stretch."""
        if self.best is None:
            return None
        states = self.best(np.linspace(0.0, self.best.duration, STATES))
        states[0], states[-1] = self.best.positions[0], self.best.positions[-1]
        first = int(self.rng.integers(0, STATES - 2))
        last = int(self.rng.integers(first + 2, STATES))
        q = self._free_state(states[(first + last) // 2])
        return None if q is None else np.concatenate([states[: first + 1], q[None], states[last:]])


def search(job: Job) -> Run:
    """Return a run of the search; its parameter is the CPU time, ``seconds``."""
    problem = load_problem(job.problem)
    setup = assemble(problem, robot(), job.seed)
    one = MotionSearch(problem, setup, job.seed)
    one.run(WARM_UP_SECONDS if job.experiment == WARM_UP else float(job.params["seconds"]))
    found: Run = {"solved": one.best is not None, "direct": lower_bound(setup), "tried": one.tried, "fault": ""}
    if one.best is None:
        return found
    return found | {"duration": one.best.duration, "how": one.how, "history": one.history}
