"""Duration as the objective: motions from rest to rest, as fast or as calm as limits and obstacles allow.

A motion is a spline in time (:class:`apex_ompl.timing.timed_spline.TimedSpline`). Its control points and its knot
spacing are optimized together by an interior-point method
(:mod:`apex_ompl.kernel.compiled.timing.duration_optimization`) with the limits of velocity, acceleration and jerk and
the clearances at its samples as constraints: first with few knots, then with more. What comes out still has to be
proved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.duration import DurationReport, DurationSettings, TimeGrid, lower_duration
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.paths.path import resample
from apex_ompl.robot.model import Limits
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.timing.spline_method import least_knot_spacing
from apex_ompl.timing.timed_spline import PINNED, Start, TimedSpline, basis
from apex_ompl.types import Array, Flags
from apex_ompl.util.validation import check_name, check_number, check_states

if TYPE_CHECKING:
    from apex_ompl.kernel.constraints import ConstraintRows

OBJECTIVES = ("time", "length", "calm")
"""What a plan is to be: fast, short, or calm, which is the least integral of the squared jerk in some more time."""

DEFAULT_OBJECTIVE = "time"
CALM_FACTOR = 1.1  # duration of a calm motion as a multiple of the fastest one's, by default
MOST_CALM = 100.0

RAMP = 0.25  # share of the first guess in which its speed grows, and falls
RAMPS = 0.35  # duration of both [s]
GUESS_STATES = 257  # of a path
CLOSER = 0.004  # margin that a round of repair adds [m]
MOST_SPANS = 400
FEW_STATES = 33  # of a path, for its clearance
DEEP, STUCK = -0.02, 0.8  # clearance of a motion with little hope [m], and least ratio to the one before a round
SLOWER = 1.15  # ratio of its duration to the one that it is to undercut
PROX = 1e-3  # weight of half the squared change of a sample in a step [1/rad^2]
LARGEST, CAREFUL = 0.25, 0.06  # change of a control point in a step, and where these go through an obstacle [rad]
DETOUR, WORTH = 1.03, 0.98  # over the direct duration, beyond which less margin is tried, and what it has to save
GREW = 1.3  # ratio of a duration to that of the first guess
LOST = -0.01  # clearance of a motion that is on the wrong side of an obstacle [m]
DECREASE = 0.3  # share of the mean of slacks times multipliers that a step aims at
STEPS = 30  # of a round, at most


@dataclass(frozen=True)
class Level:
    """Settings of a round of the optimization.

    Attributes:
        rate: Knots a second, about.
        samples: Number of samples of a knot spacing.
        margin: Least clearance at these; nearer ends of a motion are allowed for [m].
        horizon: Clearances above it are left out [m].
        slack: Factor on the least knot spacing at the start.
        mean: Mean of slacks times multipliers at the start.
        tolerance: What the objective may be off the optimum.
        penalty: Weight of half the squared rows of constraints [1/m^2, 1/rad^2].
    """

    rate: float
    samples: int
    margin: float
    horizon: float
    slack: float
    mean: float
    tolerance: float
    penalty: float = 1e6


LEVELS = (
    Level(10.0, 4, 0.005, 0.04, 1.03, 1e-4, 4e-2, 1e3),
    Level(25.0, 4, 0.005, 0.02, 1.01, 2e-5, 2e-2, 1e5),
    Level(57.0, 2, 0.005, 0.02, 1.003, 5e-6, 5e-3),
)
NARROW_LEVELS = tuple(replace(level, margin=0.001) for level in LEVELS)
CALM = Level(57.0, 3, 0.005, 0.03, 1.0, 1e-4, 2e-2)
REPAIR = Level(57.0, 4, 0.002, 0.03, 1.01, 2e-5, 5e-3)


def check_objective(objective: str, calm_factor: float) -> None:
    """Check an objective and the duration of a calm motion as a multiple of the fastest one's.

    Raises:
        UnknownNameError: No such objective.
        ParameterError: The factor is not from 1 to 100.
    """
    check_name(objective, "objective", OBJECTIVES)
    check_number(calm_factor, "calm_factor", 1.0, MOST_CALM)


class DurationOptimizer:
    """Makes motions fast, or calm, among the static obstacles of a kernel."""

    def __init__(
        self, kernel: Kernel, limits: Limits, held: Flags | None = None, constraints: ConstraintRows | None = None
    ) -> None:
        """Optimize motions of the kernel's robot.

        Args:
            kernel: The robot among its obstacles.
            limits: Limits of the motions.
            held: Whether joints stay, shape (dof,).
            constraints: Constraints along the motions, kept by a penalty that grows with the number of knots, or None.

        Raises:
            ParameterError: The limits are those of other joints.
        """
        dof = kernel.robot.dof
        if len(limits.velocity) != dof:
            raise ParameterError("limits", len(limits.velocity), f"those of {dof} joints")
        self.kernel, self.limits, self._constraints = kernel, limits, constraints
        self._held = np.zeros(dof, bool) if held is None else held
        self._limits = np.stack([limits.velocity, limits.acceleration, limits.jerk])
        self._limits[:, self._held] = 0.0

    def fastest(
        self, states: Array, stop: Callable[[], bool] = lambda: False, most: float = np.inf, narrow: bool = False
    ) -> TimedSpline | None:  # fmt: skip
        """Return a locally fastest motion near a path.

        Args:
            states: The path, shape (N, dof).
            stop: Called between rounds; True ends the optimization.
            most: Duration that the motion is to undercut [s]; where a round leaves little hope, the rest are left out.
            narrow: Whether the margin is small from the first round on, for paths through narrow passages.

        Returns:
            The motion from the first state to the last, or None where these are one, the path cannot be cleared,
            ``stop`` returned True, or little hope is left.

        Raises:
            ParameterError: The path has another shape.
        """
        check_states(states, self.kernel.robot.dof, "path", least=1)
        spline = self._guess(states)
        if spline is None or stop():
            return None
        to_undercut = np.isfinite(most)
        clearance = float(self.kernel.clearance(resample(states, FEW_STATES)).min()) if to_undercut else 0.0
        levels = NARROW_LEVELS if narrow else LEVELS
        better, report = self._lowered(spline, levels[0])
        if not to_undercut and better.duration > GREW * self.least_duration(spline):  # the margin cannot be kept
            levels = NARROW_LEVELS
            better, report = self._lowered(spline, levels[0])
        if not to_undercut and report.clearance < LOST:  # a step went through an obstacle
            better, report = self._lowered(spline, levels[0], largest=CAREFUL)
        for level in levels[1:]:
            hopeless = report.clearance < (min(DEEP, STUCK * clearance) if to_undercut else LOST)
            if hopeless or better.duration > SLOWER * most or stop():
                return None
            clearance = report.clearance
            better, report = self._lowered(self._refitted(better, level), level)
        if better.duration > DETOUR * float(direct_durations(states[0], states[-1:], self.limits)[0]) and not stop():
            closer, report = self._lowered(better, NARROW_LEVELS[-1])
            if report.clearance > LOST and closer.duration < WORTH * better.duration:
                return closer
        return better

    def cleared(self, spline: TimedSpline, times: int = 1) -> TimedSpline:
        """Return a motion that keeps more distance, of more samples, for one that was not proved.

        Args:
            spline: The motion.
            times: How often its repair was tried.
        """
        better, _ = self._lowered(spline, REPAIR, samples=REPAIR.samples * times, margin=CLOSER * times)
        return better

    def calmest(self, spline: TimedSpline) -> TimedSpline:
        """Return a motion in the time of another one, inside the limits, with a small integral of the squared jerk."""
        shares = np.diff(spline.control, PINNED, axis=0)[:, ~self._held] / self.limits.jerk[~self._held]
        total = float((shares**2).sum()) / spline.spacing ** (2 * PINNED)
        if not total:
            return spline
        better, _ = self._lowered(spline, CALM, calm=1.0 / total)
        return better

    def least_duration(self, spline: TimedSpline) -> float:
        """Return the least duration within which the control points keep the limits [s]."""
        return least_knot_spacing(spline.control, self.limits) * spline.spans

    def _guess(self, states: Array) -> TimedSpline | None:
        """Return a motion along a path whose speed, by the limits of velocity, grows, stays and falls."""
        states = resample(states, GUESS_STATES)
        rates = (np.abs(np.diff(states, axis=0)) / self.limits.velocity).max(axis=1)
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1)))
        if not along[-1] > 0.0:
            return None
        duration = float(rates.sum()) + RAMPS
        wanted = along[-1] * _ramped(np.linspace(0.0, 1.0, GUESS_STATES))
        even = np.stack([np.interp(wanted, along, column) for column in states.T], axis=1)
        spans = int(np.clip(round(LEVELS[0].rate * duration), 8, MOST_SPANS // 6))
        return TimedSpline.along(even, duration, Start.at_rest(states[0]), states[-1], spans)

    def _refitted(self, spline: TimedSpline, level: Level) -> TimedSpline:
        spline = spline.lasting(least_knot_spacing(spline.control, self.limits))
        wanted = min(MOST_SPANS, int(level.rate * spline.duration))
        return spline.refitted(max(spline.spans, wanted))

    def _lowered(
        self,
        spline: TimedSpline,
        level: Level,
        *,
        calm: float = 0.0,
        samples: int = 0,
        margin: float = 0.0,
        largest: float = LARGEST,
    ) -> tuple[TimedSpline, DurationReport]:
        """Return a spline after the steps of a level, in its least duration or with ``calm`` in its own."""
        control = np.array(spline.control, order="C")
        control[PINNED:-PINNED] = control[PINNED:-PINNED].clip(self.limits.lower, self.limits.upper)
        control[:, self._held] = control[0, self._held]
        spacing = max(spline.spacing if calm else 0.0, level.slack * least_knot_spacing(control, self.limits))
        settings = DurationSettings(
            level.margin + margin, level.horizon + margin, PROX, level.mean, DECREASE, largest, level.tolerance,
            0.0 if calm else 1.0, calm, STEPS,
        )  # fmt: skip
        grid = _grid(len(control), samples or level.samples)
        if self._constraints is None:
            report = lower_duration(self.kernel, grid, self._limits, PINNED, control, spacing, settings)
        else:
            from apex_ompl.kernel.constraints import lower_constrained_duration

            report = lower_constrained_duration(
                self.kernel, self._constraints, grid, self._limits, PINNED, control, spacing, settings, level.penalty
            )
        least = least_knot_spacing(control, self.limits)
        final = max(spacing, least) if calm else least
        return TimedSpline(control, final, spline.start), report


def _ramped(share: Array) -> Array:
    """Return the share of the way after a share of the time, with ramps of speed at both ends."""
    speed = 1.0 / (1.0 - RAMP)
    first, last = speed * share**2 / (2.0 * RAMP), 1.0 - speed * (1.0 - share) ** 2 / (2.0 * RAMP)
    return np.where(share < RAMP, first, np.where(share > 1.0 - RAMP, last, speed * (share - RAMP / 2.0)))


@lru_cache(maxsize=64)
def _grid(points: int, samples: int) -> TimeGrid:
    return TimeGrid.of(points, samples, basis((np.arange(samples) + 0.5) / samples))
