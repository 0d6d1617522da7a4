"""Costs of paths among static obstacles and Levenberg-Marquardt steps on their control points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.layout import Integers, new_buffers
from apex_ompl.kernel.compiled.path import path_cost as compiled_cost
from apex_ompl.kernel.compiled.path import path_optimization
from apex_ompl.kernel.compiled.path.path_cost import CostSettings, PathReport
from apex_ompl.kernel.compiled.path.path_optimization import LEAST_DAMPING, MOST_DAMPING
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array

__all__ = [
    "LEAST_DAMPING",
    "MOST_DAMPING",
    "CostSettings",
    "PathGrid",
    "PathReport",
    "optimization_buffers",
    "optimize_path",
    "path_cost",
]


class PathGrid(NamedTuple):
    """Samples of a B-spline.

    Attributes:
        weights: Weights of the control points at N samples, shape (N, degree + 1).
        first: First control point that they belong to, shape (N,).
        gram: Gram matrix A of the speed, shape (P, P): the integral of |q'|^2 is P^T A P.
    """

    weights: Array
    first: Integers
    gram: Array


def optimization_buffers(pinned: int, points: int, dof: int) -> tuple[Integers, Array]:
    """Return memory for the steps of one path at a time, of P control points of which some are pinned at each end."""
    integers, floats = compiled_cost.optimization_buffer_sizes((points - 2 * pinned) * dof, points, dof)
    return np.empty(integers, np.int64), np.empty(floats)


def path_cost(
    kernel: Kernel, grid: PathGrid, pinned: int, control: Array, settings: CostSettings
) -> tuple[PathReport, Array, Array]:
    """Return the cost of a path, its gradient, shape (n,), and its Gauss-Newton matrix, shape (n, n).

    The formula is that of :mod:`apex_ompl.kernel.compiled.path.path_cost`; the n unknowns are the free control points.

    Args:
        kernel: The robot among its obstacles.
        grid: Samples of the path.
        pinned: Number of control points at each end that stay.
        control: Control points, shape (P, dof).
        settings: Margins and stiffness.
    """
    points, dof = control.shape
    unknowns = (points - 2 * pinned) * dof
    integers, floats, buffers = new_buffers(compiled_cost.Buffers, unknowns=unknowns, points=points, dof=dof)
    gradient = np.empty(unknowns)
    report = compiled_cost.path_cost(
        *kernel.packed, *kernel.workspace(), *grid, pinned, control, tuple(settings), integers, floats, gradient
    )
    upper = np.triu(buffers.gram[0])
    return PathReport(*report), gradient, upper + np.triu(upper, 1).T


def optimize_path(
    kernel: Kernel, grid: PathGrid, pinned: int, control: Array, settings: CostSettings,
    buffers: tuple[Integers, Array],
) -> PathReport:  # fmt: skip
    """Improve a path in place; its control points are put inside the limits.

    Args:
        kernel: The robot among its obstacles.
        grid: Samples of the path.
        pinned: Number of control points at each end that stay.
        control: Control points, shape (P, dof).
        settings: Margins, stiffness and steps.
        buffers: Memory of :func:`optimization_buffers`.
    """
    return PathReport(
        *path_optimization.optimize_path(
            *kernel.packed, *kernel.workspace(), *grid, pinned, control, tuple(settings), *buffers
        )
    )
