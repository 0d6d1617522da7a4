"""Motions made fast or calm among static obstacles: interior-point steps on splines in time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.timing import duration_optimization as compiled
from apex_ompl.kernel.compiled.timing.duration_problem import WIDTH, DurationSettings, duration_buffer_sizes
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.products import product
from apex_ompl.types import Array

__all__ = ["DurationReport", "DurationSettings", "TimeGrid", "lower_duration"]


class TimeGrid(NamedTuple):
    """Samples of a uniform cubic B-spline in time of P control points.

    Attributes:
        weights: Weights of the control points at N samples, shape (N, 4).
        first: First control point that they belong to, shape (N,).
        mass: Band of the sum of w w^T over the samples from its diagonal on, shape (P, 4).
    """

    weights: Array
    first: Integers
    mass: Array

    @classmethod
    def of(cls, points: int, samples: int, basis: Array) -> TimeGrid:
        """Return the grid of P control points.

        Args:
            points: Number of control points.
            samples: Number of samples of a knot spacing.
            basis: Weights at these, shape (samples, 4).
        """
        spans = points - WIDTH + 1
        first = np.repeat(np.arange(spans, dtype=np.int64), samples)
        mass, block = np.zeros((points, WIDTH)), product(basis.T, basis)
        for k in range(spans):
            for m in range(WIDTH):
                mass[k + m, : WIDTH - m] += block[m, m:]
        return cls(np.tile(basis, (spans, 1)), first, mass)


class DurationReport(NamedTuple):
    """What came of the steps.

    Attributes:
        spacing: Knot spacing [s].
        gap: Sum of slacks times multipliers: a bound on what is left of the objective.
        clearance: Least clearance over its margin before the last step [m]; infinite where nothing is near.
        steps: Number of steps.
    """

    spacing: float
    gap: float
    clearance: float
    steps: int


def duration_buffers(grid: TimeGrid, control: Array, pinned: int) -> tuple[Integers, Array]:
    """Return memory for the steps on control points, shape (P, dof), of which some are pinned at each end."""
    integers, floats = duration_buffer_sizes(len(control), pinned, control.shape[1], len(grid.weights))
    return np.empty(integers, np.int64), np.empty(floats)


def lower_duration(
    kernel: Kernel, grid: TimeGrid, limits: Array, pinned: int, control: Array, spacing: float,
    settings: DurationSettings,
) -> DurationReport:  # fmt: skip
    """Lower the objective of a motion from rest to rest in place, see the compiled module for formula and method.

    Args:
        kernel: The robot among its obstacles.
        grid: Samples of the motion.
        limits: Limits of velocity, acceleration and jerk, shape (3, dof); 0 for joints that stay.
        pinned: Number of control points at each end that stay.
        control: Control points, shape (P, dof), inside the position limits.
        spacing: Knot spacing, with which the motion is inside all limits [s].
        settings: Objective, margin and steps.
    """
    return DurationReport(
        *compiled.lower_duration(
            *kernel.packed, *kernel.workspace(), *grid, limits, pinned, float(spacing), control, tuple(settings),
            *duration_buffers(grid, control, pinned),
        )
    )  # fmt: skip
