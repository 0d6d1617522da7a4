"""Motions of single joints from rest to rest: durations by distance, and distances by duration, obstacles ignored.

The fastest profile of constant jerks for the distance d: with the ramp a/j of the acceleration T = d/v + v/a + a/j
where the largest velocity v is reached, else T = a/j + sqrt((a/j)^2 + 4 d/a) where the largest acceleration a is, else
T = (32 d/j)^(1/3); where v < a^2/j, v is reached without a: T = d/v + 2 sqrt(v/j).
"""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.robot.model import Limits
from apex_ompl.types import Array


def direct_durations(start: Array, goals: Array, limits: Limits) -> Array:
    """Return the least durations of motions from rest to rest, obstacles ignored, shape (N,) [s].

    Args:
        start: Start state, shape (dof,).
        goals: Goal states, shape (N, dof).
        limits: Limits of the joints.
    """
    d, (v, a, j) = np.abs(goals - start), (limits.velocity, limits.acceleration, limits.jerk)
    ramp, ramps = a / j, _ramps(limits)
    ramped = np.where((v >= a * ramp) & (d >= 2.0 * a * ramp**2), ramp + np.sqrt(ramp**2 + 4.0 / a * d), 0.0)
    durations: Array = np.where(d >= 2.0 * v * ramps, d / v + 2.0 * ramps, ramped)
    jerky = durations == 0.0
    durations[jerky] = [math.cbrt(cube) for cube in (32.0 / j * d)[jerky].tolist()]  # the same bits everywhere
    longest: Array = durations.max(axis=1)
    return longest


def direct_reach(duration: float, limits: Limits) -> Array:
    """Return how far the joints move from rest to rest in a duration [s], obstacles ignored, shape (dof,)."""
    v, a, j = limits.velocity, limits.acceleration, limits.jerk
    ramp, ramps = a / j, _ramps(limits)
    ramped = a * ((duration - ramp) ** 2 - ramp**2) / 4.0
    between = np.where((v >= a * ramp) & (duration >= 4.0 * ramp), ramped, j * duration**3 / 32.0)
    distances: Array = np.where(duration >= 4.0 * ramps, v * (duration - 2.0 * ramps), between)
    return distances


def _ramps(limits: Limits) -> Array:
    """Return half of the duration in which the speed grows to the largest, shape (dof,) [s]."""
    v, a, j = limits.velocity, limits.acceleration, limits.jerk
    half: Array = np.where(v < a * (a / j), np.sqrt(v / j), (v / a + a / j) / 2.0)
    return half
