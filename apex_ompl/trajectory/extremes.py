"""Extremes of motions whose jerk is constant between knots: exact, not those of samples."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from apex_ompl.types import Array

ULPS = 4.0  # units in the last place by which times and accelerations of knots may be rounded, each several times


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
    def of(cls, times: Array, positions: Array, velocities: Array, accelerations: Array, jerks: Array) -> Self:
        """Return the extremes of a motion.

        Velocities are largest at knots or where the acceleration is 0, positions where a joint turns round.

        Args:
            times: Times of the knots, shape (K,) [s].
            positions: At the knots, shape (K, dof).
            velocities: At the knots, likewise.
            accelerations: At the knots, likewise.
            jerks: Between the knots, shape (K - 1, dof).
        """
        q, v, a, j = positions[:-1], velocities[:-1], accelerations[:-1], jerks
        length = np.broadcast_to(np.diff(times)[:, None], j.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = _inside(-a / j, length)
        inner = v + turn * (a + turn * j / 2.0)
        least = np.minimum(np.minimum(v, velocities[1:]), inner)
        largest = np.maximum(np.maximum(v, velocities[1:]), inner)
        back = (least < 0.0) & (largest > 0.0)
        low, high = positions.min(axis=0), positions.max(axis=0)
        joint, q, v, a, j, length = np.nonzero(back)[1], q[back], v[back], a[back], j[back], length[back]
        with np.errstate(divide="ignore", invalid="ignore"):
            side = np.sqrt(a * a - 2.0 * j * v)
            roots = [(-a + side) / j, (-a - side) / j, -v / a]
        for root in roots:
            since = _inside(root, length)
            there = q + since * (v + since * (a / 2.0 + since * j / 6.0))
            np.minimum.at(low, joint, there)
            np.maximum.at(high, joint, there)
        fastest = np.abs(velocities).max(axis=0)
        if len(inner):
            fastest = np.maximum(fastest, np.maximum(largest.max(axis=0), -least.min(axis=0)))
        return cls(low, high, fastest, np.abs(accelerations).max(axis=0), _least_jerk(times, accelerations))

    def slower(self, factor: float) -> Self:
        """Return the extremes of the same motion in a time that is ``factor`` times as long."""
        rest = self.velocity / factor, self.acceleration / factor**2, self.jerk / factor**3
        return type(self)(self.low, self.high, *rest)


def _inside(times: Array, length: Array) -> Array:
    """Return times inside of pieces, 0 to ``length``; an end where there is no such time."""
    return np.fmax(np.fmin(times, length), 0.0)


def _least_jerk(times: Array, accelerations: Array) -> Array:
    """Return the largest jerk of each joint, shape (dof,), less what the rounding of knots can be worth."""
    a, lengths = accelerations, np.diff(times) + ULPS * np.spacing(times[1:])
    change = np.abs(np.diff(a, axis=0)) - ULPS * np.spacing(np.maximum(np.abs(a[1:]), np.abs(a[:-1])))
    found: Array = (np.maximum(change, 0.0) / lengths[:, None]).max(axis=0, initial=0.0)
    return found
