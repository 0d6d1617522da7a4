"""Samples of motions, and their extremes."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from apex_ompl.kernel.timing import motion_extremes
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line


class Extremes(NamedTuple):
    """Least and largest positions, largest velocities, accelerations and jerks of a motion, each of shape (dof,).

    Jerks are lower bounds within the rounding of the knots. Knots of different joints may be 1e-10 s apart, and there
    the rounding of times and accelerations alone changes a jerk by 1e-6 of it and more.
    """

    low: Array
    high: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    @classmethod
    def of(cls, times: Array, positions: Array, velocities: Array, accelerations: Array) -> Self:
        """Return the extremes of a motion: :func:`apex_ompl.kernel.timing.motion_extremes`.

        Args:
            times: Times of the knots, shape (K,) [s].
            positions: At the knots, shape (K, dof).
            velocities: At the knots, shape (K, dof).
            accelerations: At the knots, shape (K, dof).
        """
        return cls(*motion_extremes((times, positions, velocities, accelerations)))

    @property
    def rates(self) -> Array:
        """Largest velocities, accelerations and jerks, shape (3, dof)."""
        return np.stack([self.velocity, self.acceleration, self.jerk])

    def slower(self, factor: float) -> Self:
        """Return the extremes of the same motion in a time that is ``factor`` times as long."""
        rest = self.velocity / factor, self.acceleration / factor**2, self.jerk / factor**3
        return type(self)(self.low, self.high, *rest)


class Sample(NamedTuple):
    """State of a trajectory at one time, or at several.

    Attributes:
        time: Time since the start, a number or shape (N,) [s].
        position: Shape (..., dof) [rad; synergies 0..1].
        velocity: Shape (..., dof) [rad/s].
        acceleration: Shape (..., dof) [rad/s^2].
    """

    time: float | Array
    position: Array
    velocity: Array
    acceleration: Array

    def __repr__(self) -> str:
        """Return the time and the shapes of the rest."""
        return fields_line(self)
