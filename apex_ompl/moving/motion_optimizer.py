"""Optimization in space and time among dynamic obstacles, from initial motions, and a pool of candidates.

A motion starts from a moving state and ends at rest at a goal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.moving import SAMPLE_WIDTH, MotionCost, optimize_motion
from apex_ompl.kernel.path import CostSettings, PathGrid, PathReport
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Trajectory
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import PINNED, Start, TimedSpline, basis, slopes
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array

ROUNDS = 4  # rounds of steps of a repair, between which a motion over its limits gets more time
SLOWER = 1.02  # least factor on its duration then
ROUND, MOST_ROUNDS = 4, 8  # optimizer steps in a round of a pool, and largest number of rounds of a candidate
PENALTY = 2.0  # factor on the priority of a candidate for every round spent on it
CLEAR = -0.003  # clearance at the samples above which a proof is tried; spheres protrude [m]
ENOUGH = 0.03  # clearance at which a round ends early [m]
REFIT = 64  # states of a candidate that is refitted to another start
FASTER = 0.9  # factor on the duration of a proved motion, from which a faster one is sought
LONGEST = 60.0  # duration at which a candidate is dropped [s]
LEAST = 1e-6  # clearance cost that counts as none


class InitialMotion(NamedTuple):
    """A motion that an optimization starts from.

    Attributes:
        states: States evenly spaced in time, shape (N, dof).
        goal: Where it ends, shape (dof,).
        duration: Estimate of its shortest duration without obstacles [s].
        timed: Whether it is a motion of that duration, not a path.
    """

    states: Array
    goal: Array
    duration: float
    timed: bool = False


def shortest_duration(states: Array, limits: Limits, *, even: bool = False) -> float:
    """Return a lower bound of the duration of a motion along a path [s], at least 0.1 s.

    It is the largest of L_j / v_j over the joints, for lengths L_j of their ways and velocity limits v_j, and of
    2 sqrt(d_j / a_j) for their displacements d_j and acceleration limits a_j. At an even pace of the path's parameter,
    each of the N - 1 steps takes the same time: L_j is then N - 1 times the joint's longest step.

    Args:
        states: States of the path, shape (N, dof).
        limits: Limits of the joints.
        even: Whether the pace is even.
    """
    steps = np.abs(np.diff(states, axis=0))
    way = len(steps) * steps.max(axis=0) if even else steps.sum(axis=0)
    distance = np.abs(states[-1] - states[0]) / limits.acceleration
    return float(max((way / limits.velocity).max(), 2.0 * np.sqrt(distance.max()), 0.1))


@dataclass(frozen=True)
class MotionSettings:
    """Cost of a motion, and when its optimization ends.

    Attributes:
        samples: Number of samples between two knots.
        scene_margin: Clearance to obstacles and dynamic obstacles below which a sample costs [m].
        own_margin: Clearance between the robot's own links below which a sample costs [m].
        stiffness: Weight of half the integral of the speed squared over the share of the motion [1/rad^2].
        limit_weight: Weight of half the square of the excess over a limit, as a share of it.
        limit_share: Share of the limits above which there is a cost.
        damping: Weight of the speed of the change at the first step.
        steps: Largest number of steps of a round.
        tolerance: A step that lowers the cost by less than this share is the last.
    """

    samples: int = 4
    scene_margin: float = 0.04
    own_margin: float = 0.02
    stiffness: float = 1e-3
    limit_weight: float = 1.0
    limit_share: float = 0.97
    damping: float = 1e-2
    steps: int = 16
    tolerance: float = 1e-3


class MotionOptimizer:
    """Levenberg-Marquardt on splines in time, among static and dynamic obstacles; without random numbers of its own.

    The cost is that of :class:`apex_ompl.kernel.moving.MotionCost`.

    Attributes:
        samples: Number of samples of all steps so far.
    """

    def __init__(
        self, kernel: Kernel, dynamic: DynamicObstacles, limits: Limits, settings: MotionSettings | None = None,
        given: Callable[[Array], Array] | None = None,
    ) -> None:  # fmt: skip
        """Optimize motions of the kernel's robot within limits of velocity, acceleration and jerk.

        Args:
            kernel: The robot among static obstacles; joints that stay, or are given, have limits there that are equal.
            dynamic: The dynamic obstacles.
            limits: Limits of all joints.
            settings: Settings of the cost.
            given: Values of joints that follow a given motion at times of the clock, shape (N,) [s], NaN of the other
                joints, shape (N, dof); None where there are no such joints.

        Raises:
            ParameterError: The limits are those of other joints.
        """
        check_array(limits.velocity, (kernel.robot.dof,), "limits")
        self.kernel, self.dynamic, self.limits = kernel, dynamic, limits
        self.settings, self.given = settings or MotionSettings(), given
        self.samples = 0

    def improve(
        self, spline: TimedSpline, *, clock: float = 0.0, steps: int | None = None, enough: float = np.inf,
        damping: float | None = None,
    ) -> tuple[TimedSpline, PathReport]:  # fmt: skip
        """Return a spline of the same duration with a lower cost, and what came of the steps.

        Args:
            spline: The spline.
            clock: Time of the dynamic obstacles' stamps when it starts [s].
            steps: Most steps; by default the settings'.
            enough: The steps end when the clearances at the samples reach this [m].
            damping: Damping of the first step; by default the settings'. The report has that of the next one.

        Raises:
            ParameterError: Control points of another shape.
        """
        steps = self.settings.steps if steps is None else steps
        better, report, _ = self._run(spline, clock, steps, enough, 0, damping=damping)
        return better, report

    def evaluate(self, spline: TimedSpline, *, clock: float = 0.0) -> tuple[PathReport, Array]:
        """Return what a spline costs, and its gradient, shape (free control points, dof)."""
        dof = self.kernel.robot.dof
        _, report, slope = self._run(spline, clock, 0, np.inf, (len(spline.control) - 2 * PINNED) * dof)
        return report, slope.reshape(-1, dof)

    def repair(
        self, spline: TimedSpline, accepts: Callable[[Trajectory], bool], *, clock: float = 0.0,
        stop: Callable[[], bool] = lambda: False,
    ) -> Trajectory | None:  # fmt: skip
        """Return a motion that keeps the limits and is accepted, or None.

        Between rounds of steps a motion that is over its limits gets as much more time as it needs.

        Args:
            spline: Where to start from.
            accepts: The full check; asked about motions within the limits.
            clock: Time of the dynamic obstacles' stamps when it starts [s].
            stop: Asked between rounds whether to give up.
        """
        names = self.kernel.robot.joint_names
        for _ in range(ROUNDS):
            if stop():
                return None
            spline, _ = self.improve(spline, clock=clock)
            least = least_knot_spacing(spline.control, self.limits)
            if least > spline.spacing:
                spline = spline.lasting(max(least, SLOWER * spline.spacing))
                if least_knot_spacing(spline.control, self.limits) > spline.spacing:
                    continue
            motion = spline.trajectory(names)
            if accepts(motion):
                return motion
        return None

    def _run(
        self,
        spline: TimedSpline,
        clock: float,
        steps: int,
        enough: float,
        slopes: int,
        *,
        damping: float | None = None,
    ) -> tuple[TimedSpline, PathReport, Array]:
        control = np.array(spline.control, order="C")
        points, dof = len(control), self.kernel.robot.dof
        if points <= 2 * PINNED:
            raise ParameterError("control points", points, f"more than {2 * PINNED}")
        check_array(control, ("P", dof), "control points", finite=True)
        s, limits = self.settings, self.limits
        grid = _grid(points, s.samples)
        times = clock + (np.arange(len(grid.weights)) + 0.5) / len(grid.weights) * spline.duration
        powers = np.power(spline.spacing, [[1.0], [2.0], [3.0]])
        most = s.limit_share * powers * np.stack([limits.velocity, limits.acceleration, limits.jerk])
        given = np.empty((0, dof)) if self.given is None else self.given(times)
        cost = MotionCost(grid, times, most, s.limit_weight, self._cost_settings(steps, enough, damping), given)
        report, slope = optimize_motion(self.kernel, self.dynamic.packed, cost, PINNED, control, slopes)
        self.samples += (report.steps + 1) * len(times)
        return spline._replace(control=control), report, slope

    def _cost_settings(self, steps: int, enough: float, damping: float | None) -> CostSettings:
        s = self.settings
        return CostSettings(
            float(s.scene_margin), float(s.own_margin), float(s.stiffness),
            float(s.damping if damping is None else damping), float(enough), float(s.tolerance), int(steps),
        )  # fmt: skip


@lru_cache(maxsize=64)
def _grid(points: int, samples: int) -> PathGrid:
    """Return weights at the samples, where they start, and the matrix of the speed over the share of the motion."""
    spans = points - PINNED
    at = (np.arange(samples) + 0.5) / samples
    weights = np.tile(basis(at), (spans, 1))
    first = np.repeat(np.arange(spans), samples)
    nodes, shares = np.polynomial.legendre.leggauss(SAMPLE_WIDTH)
    rates = slopes((nodes + 1.0) / 2.0) * spans
    block = (rates.T * (shares / 2.0 / spans)) @ rates
    gram = np.zeros((points, points))
    for k in range(spans):
        gram[k : k + SAMPLE_WIDTH, k : k + SAMPLE_WIDTH] += block
    return PathGrid(np.ascontiguousarray(weights), first.astype(np.int64), gram)


@dataclass(eq=False)
class MotionCandidate:
    """A motion under repair.

    Attributes:
        spline: The motion.
        goal: Where it ends, shape (dof,).
        origin: Name of what made it.
        cost: Part of its cost that is due to clearance.
        clear: Whether a proof is tried: no sample is in contact.
        damping: Damping of the next step.
        rounds: Number of rounds that it had.
        given_up: Whether it is dropped.
    """

    spline: TimedSpline
    goal: Array
    origin: str
    cost: float
    clear: bool
    damping: float | None = None
    rounds: int = 0
    given_up: bool = False

    @property
    def priority(self) -> float:
        """Clearance cost times duration, doubled for every round; the least is improved next."""
        return (self.cost + LEAST) * self.spline.duration * PENALTY**self.rounds


class MotionPool:
    """Candidates for a motion from one start; the most promising one is improved next.

    Attributes:
        candidates: All candidates.
    """

    def __init__(
        self, optimizer: MotionOptimizer, start: Start, clock: float, budget: ComputeBudget,
        accepts: Callable[[Trajectory], bool], *, clearance_margin: float = 0.0,
    ) -> None:  # fmt: skip
        """Start an empty pool.

        Args:
            optimizer: Improves motions among the obstacles.
            start: State of the robot when the motions start.
            clock: Clock time then [s].
            budget: Counts the samples.
            accepts: The proof.
            clearance_margin: Margin of the optimizer's obstacles that a motion may lack when its proof is tried [m].
        """
        self._optimizer, self._start, self._clock, self._budget = optimizer, start, clock, budget
        self._accepts, self._least = accepts, CLEAR - clearance_margin
        self.candidates: list[MotionCandidate] = []
        self._own: dict[bytes, float] = {}

    def add(self, states: Array, duration: float, goal: Array, origin: str) -> MotionCandidate:
        """Add a motion.

        Args:
            states: States evenly spaced in time, shape (N, dof).
            duration: Its duration [s].
            goal: Where it ends, shape (dof,).
            origin: Name of what made it.
        """
        spline = TimedSpline.along(states, duration, self._start, goal)
        one = MotionCandidate(spline, goal, origin, np.inf, False)
        self._improve(one, 0)
        self.candidates.append(one)
        return one

    def carry(self, one: MotionCandidate, shift: float) -> None:
        """Add a candidate of an earlier pool, whose motion was to start some time earlier [s].

        It is kept where the robot still is at rest at its start, and refitted to the robot's state otherwise.
        """
        old, now = one.spline.start, self._start
        resting = not (old.velocity.any() or now.velocity.any() or now.acceleration.any())
        if resting and np.array_equal(old.position, now.position):
            same = replace(one, damping=None)
            self._improve(same, 0)
            self.candidates.append(same)
            return
        motion = one.spline.trajectory(self._optimizer.kernel.robot.joint_names)
        start = min(shift, 0.5 * motion.duration)
        rest = motion(np.linspace(start, motion.duration, REFIT))
        self.add(rest, motion.duration - start, one.goal, one.origin)

    def improve(self, shorter: Callable[[], float], until: float = np.inf) -> tuple[MotionCandidate, Trajectory] | None:
        """Improve candidates until one is proved, or the time is up.

        Args:
            shorter: Returns the duration that motions must be shorter than [s].
            until: Time of the budget at which to pause [s].
        """
        while not self._budget.over() and self._budget.spent < until:
            open_ones = [
                one
                for one in self.candidates
                if one.rounds < MOST_ROUNDS and not one.given_up and one.spline.duration < shorter()
            ]
            if not open_ones:
                return None
            one = min(open_ones, key=lambda one: one.priority)
            if not one.clear or one.rounds:
                self._improve(one, ROUND)
            one.rounds += 1
            least = least_knot_spacing(one.spline.control, self._optimizer.limits)
            if least > one.spline.spacing:
                one.spline = one.spline.lasting(max(least, SLOWER * one.spline.spacing))
                one.given_up = one.spline.duration > LONGEST
                if least_knot_spacing(one.spline.control, self._optimizer.limits) > one.spline.spacing:
                    continue
                self._improve(one, 0)
            if not one.clear or one.spline.duration >= shorter():
                continue
            motion = one.spline.trajectory(self._optimizer.kernel.robot.joint_names)
            if self._accepts(motion):
                one.spline, one.rounds = one.spline.lasting(FASTER * one.spline.spacing), 0  # next, a faster one
                self._improve(one, 0)
                return one, motion
        return None

    def _own_clearance(self, goal: Array) -> float:
        """Return the least clearance of the robot's own spheres at the start and a goal [m]: held objects may touch."""
        key = goal.tobytes()
        if key not in self._own:
            ends = np.stack([self._start.position, goal])
            self._own[key] = float(self._optimizer.kernel.clearance(ends, 0.1)[:, 1].min())
        return self._own[key]

    def _improve(self, one: MotionCandidate, steps: int) -> None:
        before = self._optimizer.samples
        one.spline, report = self._optimizer.improve(
            one.spline, clock=self._clock, steps=steps, enough=ENOUGH, damping=one.damping
        )
        self._budget.spend("sample of a motion", self._optimizer.samples - before)
        one.cost = report.clearance_cost
        ends = self._own_clearance(one.goal)
        one.clear = report.scene_clearance >= self._least and report.own_clearance >= min(0.0, ends) + CLEAR
        one.damping = report.damping if steps else one.damping
