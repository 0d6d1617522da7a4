"""Extremes of motions whose jerk is constant between knots: exact, not those of samples."""

from __future__ import annotations

from typing import NamedTuple, Self

from apex_ompl.kernel.timing import motion_extremes
from apex_ompl.types import Array


class Extremes(NamedTuple):
    """Least and largest positions, largest velocities, accelerations and jerks of a motion, each of shape (dof,).

    Jerks are the least that the knots can be said to have: between knots 1e-10 s apart, as several joints' own make
    them, the rounding of times and accelerations alone is worth 1e-6 of a jerk and more.
    """

    low: Array
    high: Array
    velocity: Array
    acceleration: Array
    jerk: Array

    @classmethod
    def of(cls, times: Array, positions: Array, velocities: Array, accelerations: Array) -> Self:
        """Return the extremes of a motion (:func:`apex_ompl.kernel.timing.motion_extremes`).

        Args:
            times: Times of the knots, shape (K,) [s].
            positions: At the knots, shape (K, dof).
            velocities: At the knots, likewise.
            accelerations: At the knots, likewise.
        """
        return cls(*motion_extremes((times, positions, velocities, accelerations)))

    def slower(self, factor: float) -> Self:
        """Return the extremes of the same motion in a time that is ``factor`` times as long."""
        rest = self.velocity / factor, self.acceleration / factor**2, self.jerk / factor**3
        return type(self)(self.low, self.high, *rest)
