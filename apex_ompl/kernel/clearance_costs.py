"""Clearance costs of states, with gradients and Gauss-Newton matrices, in terms of NumPy arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel.compiled.layout import pack, unpack
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import DynamicArrays
from apex_ompl.kernel.compiled.moving.state_costs import state_costs
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import check_array, check_positive, finite_array

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
