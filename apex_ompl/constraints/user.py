"""Constraints of a user's own: objects with a residual, its Jacobian and a bound."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.types import Array
from apex_ompl.util.arrays import length


@runtime_checkable
class UserConstraint(Protocol):
    """A constraint |r(q)| <= tolerance of a user's own, given to planners among the records.

    Attributes:
        name: Its name in messages and results.
        tolerance: Largest |r| with which it holds, above 0, in the unit of r.
    """

    name: str
    tolerance: float

    def residual(self, q: Array) -> Array:
        """Return r(q), shape (m,), at a state, shape (dof,)."""

    def jacobian(self, q: Array) -> Array:
        """Return the derivative of r at a state, shape (m, dof)."""

    def bound(self, q: Array, step: Array) -> float:
        """Return a number that |r(q + u step)| does not exceed for any u in [-1, 1]; infinity where none is known."""


def check_user_constraint(constraint: object, start: Array) -> UserConstraint:
    """Return a user's constraint after a call of its methods at the start, shape (dof,).

    Raises:
        ParameterError: It has no name, no positive tolerance, no such methods, or these return something else.
    """
    if not isinstance(constraint, UserConstraint):
        expected = "a constraint, or an object with name, tolerance, residual(q), jacobian(q) and bound(q, step)"
        raise ParameterError("constraint", constraint, expected)
    name, tolerance = constraint.name, constraint.tolerance
    if not isinstance(name, str) or not name:
        raise ParameterError("name of a constraint", name, "a text")
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float, np.number)) or not 0 < tolerance < np.inf:
        raise ParameterError(f"tolerance of {name}", tolerance, "a positive number")
    residual = _numbers(constraint.residual(start.copy()), f"residual of {name}", (-1,))
    _numbers(constraint.jacobian(start.copy()), f"jacobian of {name}", (len(residual), len(start)))
    bound, size = constraint.bound(start.copy(), np.zeros_like(start)), length(residual)
    if not isinstance(bound, (int, float, np.number)) or not bound >= size * (1.0 - 1e-12):
        raise ParameterError(f"bound of {name} with a step of 0", bound, f"a number from |residual| = {size:.6g}")
    return constraint


def _numbers(value: object, name: str, shape: tuple[int, ...]) -> Array:
    """Return an array of finite numbers of a shape; -1 stands for one or more."""
    try:
        found = np.array(value, float)
    except (TypeError, ValueError):
        found = np.full(0, np.nan)
    fits = found.ndim == len(shape) and all(
        n == m or (m == -1 and n > 0) for n, m in zip(found.shape, shape, strict=True)
    )
    if not fits or not np.isfinite(found).all():
        text = ", ".join("m" if n == -1 else str(n) for n in shape)
        raise ParameterError(name, value, f"finite numbers of shape ({text}{',' if len(shape) == 1 else ''})")
    return found
