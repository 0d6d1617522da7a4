"""Bounds on the violation of constraints along whole paths and motions.

Those of this package are proved in compiled code (:mod:`apex_ompl.kernel.compiled.constraint.proof`). A constraint of a
user's own is bounded by its own ``bound`` over pieces of straight lines that are bisected; along a motion these are the
lines between its states STEP apart in time.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Protocol

import numpy as np

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.user import UserConstraint
from apex_ompl.kernel import constraints as kernel
from apex_ompl.types import Array
from apex_ompl.util.arrays import length
from apex_ompl.util.display import fields_line

STEP = 1e-3  # between states of a motion that are joined by straight lines for constraints of a user's own [s]
DEPTH = 12  # how often a straight line is bisected for these


class Motion(Protocol):
    """A motion with constant jerk between its knots, such as :class:`apex_ompl.timing.Trajectory`."""

    @property
    def times(self) -> Array: ...  # noqa: D102
    @property
    def positions(self) -> Array: ...  # noqa: D102
    @property
    def velocities(self) -> Array: ...  # noqa: D102
    @property
    def accelerations(self) -> Array: ...  # noqa: D102
    def __call__(self, t: Array, /) -> Array: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class ConstraintCertificate:
    """Bounds on the violation of C constraints along a curve.

    Attributes:
        violations: Largest |r| at the states that were examined, shape (C,), in the unit of each one's tolerance.
        bounds: Upper bounds on the largest |r| anywhere, shape (C,); infinite where none was proved.
        fault: A sentence on the constraint that is not proved to hold, empty where all are.
    """

    violations: Array
    bounds: Array
    fault: str = ""

    __repr__ = fields_line

    def __bool__(self) -> bool:
        """Whether all constraints are proved to hold."""
        return not self.fault


def prove_path(constraints: ConstraintSet, states: Array) -> ConstraintCertificate:
    """Return bounds along the straight lines between states, shape (N, dof).

    Raises:
        ParameterError: Another shape.
    """
    groups = None if constraints.rows is None else kernel.prove_path(constraints.rows, states)
    return _certificate(constraints, groups, states)


def prove_motion(constraints: ConstraintSet, motion: Motion) -> ConstraintCertificate:
    """Return bounds along a motion."""
    knots = motion.times, motion.positions, motion.velocities, motion.accelerations
    groups = None if constraints.rows is None else kernel.prove_motion(constraints.rows, *knots)
    first, last = motion.times[[0, -1]]
    count = int(np.ceil((last - first) / STEP)) + 1
    states = motion(np.linspace(first, last, count)) if constraints.user else motion.positions
    return _certificate(constraints, groups, states)


def _certificate(
    constraints: ConstraintSet, groups: kernel.ConstraintProof | None, states: Array
) -> ConstraintCertificate:
    """Return the certificate of a curve, of which compiled code has bounded the groups, and its states."""
    user = [_bounded(one, states) for one in constraints.user]
    sizes, bounds = (np.array([pair[k] for pair in user], float) for k in range(2))
    none = np.empty(0)
    found = groups.violations if groups is not None else none, groups.bounds if groups is not None else none
    violations = constraints.by_constraint(found[0], sizes)
    proved = constraints.by_constraint(found[1], bounds)
    wrong = np.flatnonzero(~(proved <= constraints.tolerances))
    fault = ""
    if len(wrong):
        k = int(wrong[np.argmax(proved[wrong] / constraints.tolerances[wrong])])
        seen = f"{violations[k]:.4g} at a state" if violations[k] > constraints.tolerances[k] else "not proved below it"
        fault = f"{constraints.names[k]} is violated, tolerance {constraints.tolerances[k]:.4g}, {seen}"
    return ConstraintCertificate(violations, proved, fault)


def _bounded(one: UserConstraint, states: Array) -> tuple[float, float]:
    """Return the largest norm at states, shape (N, dof), and a bound between them, infinite where none is known."""
    sizes = [length(np.asarray(one.residual(q.copy()), float)) for q in states]
    largest, bound = max(sizes), max(sizes)
    for a, b in zip(states, states[1:], strict=False):
        bound = max(bound, _bound_between(one, 0.5 * (a + b), 0.5 * (b - a), DEPTH))
        if not bound <= one.tolerance:
            return largest, inf
    return largest, bound


def _bound_between(one: UserConstraint, middle: Array, half: Array, depth: int) -> float:
    """Return a bound over ``middle + u half``, |u| <= 1, bisected until it is within the tolerance."""
    bound = float(one.bound(middle.copy(), half.copy()))
    if bound <= one.tolerance or depth == 0:
        return bound
    return max(_bound_between(one, middle + sign * 0.5 * half, 0.5 * half, depth - 1) for sign in (-1.0, 1.0))
