"""Error terms of alignments: angles, tolerances, and the outcome of sampling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from apex_ompl.types import Array

UP = np.array([0.0, 0.0, 1.0])
"""Upward direction of the world."""


@dataclass(frozen=True)
class AlignmentSamples:
    """States sampled for an alignment.

    Attributes:
        states: Free states that satisfy the alignment, shape (found, dof).
        attempts: Number of attempts of inverse kinematics.
        converged: Number of attempts that satisfied the alignment, free or in collision.
        best: Error terms of the best attempt.
        blocked: A collision of the last state that satisfied the alignment; empty if one was free or none satisfied it.
    """

    states: Array
    attempts: int
    converged: int
    best: Mapping[str, float]
    blocked: str

    @property
    def fault(self) -> str:
        """Reason for which there is no state, in one sentence; empty when there is one."""
        if len(self.states):
            return ""
        if self.converged:
            return f"all {self.converged} aligned states found in {self.attempts} attempts collide, {self.blocked}"
        best = ", ".join(f"{name} {value:.3g} {unit_of(name)} off" for name, value in self.best.items())
        return f"not reached in {self.attempts} attempts; the best has {best}"


def angle(a: Array, b: Array) -> float:
    """Return the angle between two vectors, atan2(|a x b|, a . b) [rad], accurate for nearly parallel vectors too."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def within(errors: Mapping[str, float], bounds: Mapping[str, float]) -> bool:
    """Whether every error is at most its bound, up to rounding."""
    return all(value <= bounds[name] + 1e-12 for name, value in errors.items())


def unit_of(name: str) -> str:
    """Return the unit of an error term."""
    return "m" if name in ("lateral", "axial") else "rad"


def relative_error(errors: Mapping[str, float], bounds: Mapping[str, float]) -> float:
    """Return the largest ratio of an error to its bound, where a bound of zero counts as 0.01."""
    return max(value / max(bounds[name], 0.01) for name, value in errors.items())


def lowest_direction(axis: Array) -> Array:
    """Return the lowest unit vector orthogonal to a unit axis, shape (3,); down itself for a vertical axis."""
    down = -UP + (UP @ axis) * axis
    length = float(np.linalg.norm(down))
    return down / length if length > 1e-9 else -UP
