"""Paths in joint space: B-splines where they have control points, polylines where they have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct
from apex_ompl.util.validation import check_integer, check_positive

SEARCH_RESOLUTION = 0.031
"""Largest spacing of the states that planners check along a motion [rad, max-norm]."""

FINE_RESOLUTION = 0.0031
"""Largest spacing of the states at which the kernel alone, without exact shapes, checks paths: training data and the
validation of models [rad, max-norm]. What counts as a solution is decided by a proof without any spacing."""


@dataclass(frozen=True, eq=False, repr=False)
class Path:
    """Path in joint space, from planner to time parameterization.

    Planners check and return ``states``, joined by straight lines. An optimized path also has the B-spline from which
    its states were sampled.

    Attributes:
        states: Waypoints, shape (N, dof) [rad; synergies 0..1].
        spline: B-spline basis, or None for a polyline.
        control: Control points of the spline, shape (points, dof), or None.
        weights: What a unit of each joint counts in the length, shape (dof,), or None where all count 1, see
            ``Robot.weights``.
    """

    states: Array
    spline: Spline | None = None
    control: Array | None = None
    weights: Array | None = None

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ParameterError: The states are not of shape (N, dof), or only one of spline and control points is given.
        """
        if np.ndim(self.states) != 2 or not len(self.states):
            raise ParameterError("path", np.shape(self.states), "states of shape (N, dof)")
        if (self.spline is None) != (self.control is None):
            raise ParameterError("path", "one of spline and control points", "both or none")

    @classmethod
    def on(cls, spline: Spline, control: Array) -> Path:
        """Return the path of a spline's control points, shape (points, dof)."""
        return cls(spline.path(control), spline, control)

    @property
    def dof(self) -> int:
        """Number of joints."""
        return int(self.states.shape[1])

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the states, (N, dof)."""
        return len(self.states), self.dof

    @property
    def length(self) -> float:
        """Sum of Euclidean joint-space steps between the states, of weighed joints [rad]; S_r of the paper."""
        return path_length(self.states, self.weights)

    def __repr__(self) -> str:
        """Return the numbers of states and joints, and the kind of the path."""
        return f"Path({len(self)} states, {self.dof} joints, {'polyline' if self.spline is None else 'B-spline'})"

    def __len__(self) -> int:
        """Number of states."""
        return len(self.states)

    def __getitem__(self, index: Any) -> Array:
        """Return states by index or slice, as of an array of shape (N, dof)."""
        return np.asarray(self.states[index])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """Return the states, so that NumPy takes a path for an array of shape (N, dof)."""
        return np.array(self.states, dtype=dtype, copy=copy)

    def __call__(self, s: ArrayLike, order: int = 0) -> Array:
        """Return positions or derivatives with respect to the path parameter.

        Args:
            s: Parameter in [0, 1], one or several of shape (M,): that of the spline; of a polyline the share of its
                length.
            order: 0 for positions; k for the k-th derivative, from the right at a polyline's waypoints.

        Returns:
            Shape (dof,), or (M, dof).

        Raises:
            ParameterError: A parameter outside [0, 1], or a negative order.
        """
        given = np.asarray(s, float)
        at = np.atleast_1d(given)
        if at.ndim != 1 or not ((at >= 0.0) & (at <= 1.0)).all():
            raise ParameterError("s", s, "parameters in [0, 1]")
        check_integer(order, "order", 0)
        if self.spline is None or self.control is None:
            found = self._polyline(at, order)
        else:
            found = np.asarray(self.spline.basis(at, order) @ self.control)
        if order == 0:
            found[at == 0.0], found[at == 1.0] = self.states[0], self.states[-1]
        return np.asarray(found[0] if given.ndim == 0 else found)

    def _polyline(self, at: Array, order: int) -> Array:
        steps = np.linalg.norm(np.diff(self.states, axis=0), axis=1)
        arc = np.concatenate([[0.0], np.cumsum(steps)])
        if order == 0 or not arc[-1] > 0.0:
            interpolated = np.stack([np.interp(at * arc[-1], arc, column) for column in self.states.T], axis=1)
            return np.asarray(interpolated if order == 0 else np.zeros_like(interpolated))
        if order > 1:
            return np.zeros((len(at), self.dof))
        moving = np.flatnonzero(steps > 0.0)
        segment = moving[np.searchsorted(arc[moving], at * arc[-1], side="right").clip(1) - 1]
        return np.asarray((self.states[segment + 1] - self.states[segment]) / steps[segment, None] * arc[-1])

    def sample(self, spacing: float) -> Array:
        """Return states along the path at most ``spacing`` apart [rad, max-norm], shape (M, dof).

        The waypoints are among them, bit for bit.

        Raises:
            ParameterError: ``spacing`` is not positive.
        """
        check_positive(spacing, "spacing", "a positive number of radians")
        pieces = [self.states[:1]]
        for a, b in pairwise(self.states):
            pieces += [states_between(a, b, spacing), b[None]]
        return np.concatenate(pieces)


def path_length(states: Array, weights: Array | None = None) -> float:
    """Return the sum of Euclidean joint-space steps of a path, shape (N, dof) [rad]; S_r of the paper.

    Args:
        states: The path.
        weights: What a unit of each joint counts, shape (dof,); None for 1.
    """
    steps = np.diff(states, axis=0)
    return float(np.linalg.norm(steps if weights is None else steps * weights, axis=1).sum())


def resample(states: Array, count: int) -> Array:
    """Return ``count`` states evenly spaced by length along a polyline, shape (count, dof), its ends among them."""
    steps = np.linalg.norm(np.diff(states, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(wanted, along, column) for column in states.T], axis=1)


def states_between(a: Array, b: Array, spacing: float) -> Array:
    """Return evenly spaced states strictly between two, at most ``spacing`` apart [rad, max-norm].

    Args:
        a: First state, shape (dof,).
        b: Last state, shape (dof,).
        spacing: Largest distance between neighbors, ``a`` and ``b`` among them.

    Returns:
        States, shape (M, dof); M is 0 where ``a`` and ``b`` are close enough.
    """
    count = max(1, int(np.ceil(float(np.abs(b - a).max()) / spacing)))
    return np.asarray(a + (np.arange(1, count) / count)[:, None] * (b - a))


def abreast(paths: Sequence[Array]) -> Array:
    """Return the states of paths that are followed at once, each in proportion to its number of states, shape (N, dof).

    Args:
        paths: States from the same start, shape (M, dof) each.
    """
    shares = [np.linspace(0.0, 1.0, len(path)) for path in paths]
    u = distinct(np.concatenate([np.array([0.0, 1.0]) if max(map(len, paths)) > 1 else np.zeros(1), *shares]))
    q = np.tile(paths[0][0], (len(u), 1))
    for path, share in zip(paths, shares, strict=True):
        if len(path) > 1:
            q += np.stack([np.interp(u, share, column) for column in (path - path[0]).T], axis=1)
    return q
