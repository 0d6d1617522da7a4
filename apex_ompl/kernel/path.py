"""Costs of paths among static obstacles, and Levenberg-Marquardt steps on their control points.

For other optimizers: clearance costs of states, with gradients and Gauss-Newton matrices.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel.compiled.layout import Integers, new_buffers, pack, unpack
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import DynamicArrays
from apex_ompl.kernel.compiled.moving.state_costs import state_costs
from apex_ompl.kernel.compiled.path import path_cost as compiled_cost
from apex_ompl.kernel.compiled.path import path_optimization
from apex_ompl.kernel.compiled.path.path_cost import CostSettings, PathReport
from apex_ompl.kernel.compiled.path.path_optimization import LEAST_DAMPING, MOST_DAMPING
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import check_array, check_positive, finite_array

__all__ = [
    "LEAST_DAMPING",
    "MOST_DAMPING",
    "NO_DYNAMIC_OBSTACLES",
    "ClearanceCosts",
    "CostSettings",
    "PathGrid",
    "PathReport",
    "clearance_costs",
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


_NOTHING = np.empty(0)
NO_DYNAMIC_OBSTACLES: tuple[Any, ...] = pack(
    DynamicArrays(
        kind=np.empty(0, np.int64), owner=np.empty(0, np.int64), grid=np.empty((0, 4), np.int64),
        allowed=np.empty((0, 2), np.int64), rotation=_NOTHING, place=_NOTHING, size=_NOTHING, velocity=_NOTHING,
        stamp=_NOTHING, growth=_NOTHING, values=np.empty(0, np.float32),
    )
)  # fmt: skip
"""No dynamic obstacles, packed."""


class ClearanceCosts(NamedTuple):
    """Clearance costs of N states; see :mod:`apex_ompl.kernel.compiled.check.clearance_cost` for the formula.

    Attributes:
        cost: Half the sum of the squared violations of the margins, each as a share of its margin, shape (N,); infinite
            where the tables of the robot do not hold for a state, whose other results are 0.
        gradient: Its gradient, shape (N, dof) [1/rad].
        gram: Its Gauss-Newton matrix, shape (N, dof, dof) [1/rad^2].
        clearance: Clearances of the sphere cover to obstacles, and of the robot to itself, at most the margins; shape
            (N, 2) [m].
    """

    cost: Array
    gradient: Array
    gram: Array
    clearance: Array


def clearance_costs(
    kernel: Kernel, states: ArrayLike, scene_margin: float, own_margin: float, times: ArrayLike | None = None,
    dynamic: tuple[Any, ...] = NO_DYNAMIC_OBSTACLES,
) -> ClearanceCosts:  # fmt: skip
    """Return the clearance costs of states, where obstacles or links are nearer than margins.

    The residuals are those of pairs: a cluster of spheres and an obstacle, or two clusters, by their nearest spheres.

    Args:
        kernel: The robot among its obstacles.
        states: States, shape (N, dof).
        scene_margin: Clearance to obstacles below which a state costs [m].
        own_margin: Clearance between links below which it costs [m].
        times: Times at which dynamic obstacles are examined, shape (N,) [s]; by default 0.
        dynamic: Dynamic obstacles, packed as :class:`apex_ompl.kernel.arrays.DynamicArrays`.

    Raises:
        ParameterError: Another shape, a margin that is not positive, or a time that is not finite.
    """
    q = kernel.states(states)
    for margin, name in ((scene_margin, "scene_margin"), (own_margin, "own_margin")):
        check_positive(margin, name)
    count, dof = q.shape
    at = np.zeros(count) if times is None else compact(finite_array(times, "times"))
    check_array(at, (count,), "times")
    offset = np.empty((len(unpack(DynamicArrays, *dynamic).kind), 3))
    values, gradient, gram = np.empty((count, 3)), np.empty((count, dof)), np.empty((count, dof, dof))
    state_costs(
        *kernel.packed, *dynamic, *kernel.workspace(), offset, q, at, float(scene_margin), float(own_margin),
        np.empty(dof), values, gradient, gram,
    )  # fmt: skip
    return ClearanceCosts(values[:, 0], gradient, gram, values[:, 1:])
