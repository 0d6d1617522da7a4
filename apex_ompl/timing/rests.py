"""Rests of motions: when no joint moves."""

from __future__ import annotations

import numpy as np

from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array, Flags

AT_REST = 1e-6
"""Largest velocity of a joint at rest [rad/s]."""


def is_at_rest(motion: Trajectory, time: float, rest: float = AT_REST) -> bool:
    """Whether no joint is faster than at rest at a time; before 0 and after the end the robot is at rest.

    Args:
        motion: The motion.
        time: The time [s].
        rest: Largest velocity of a joint at rest [rad/s].
    """
    return bool((np.abs(motion(time, 1)) <= rest).all())


def rests(motion: Trajectory) -> Array:
    """Return the intervals of time in which a motion is at rest, shape (N, 2) [s].

    In each, no joint is ever faster than ``AT_REST``. A moment of rest between two moving pieces is an interval
    of length zero. Starts and ends of intervals are knots.
    """
    slow = np.all(np.abs(motion.velocities) <= AT_REST, axis=1).tolist()
    resting = _is_resting(motion)
    found, k, last = list[tuple[int, int]](), 0, len(slow) - 1
    while k <= last:
        if slow[k]:
            end = k
            while end < last and resting[end]:
                end += 1
            found.append((k, end))
            k = end
        k += 1
    return np.asarray(motion.times[np.array(found, int).reshape(-1, 2)])


def _is_resting(motion: Trajectory) -> Flags:
    """Return whether each piece between knots is at rest, shape (K - 1,)."""
    v, a, j, t = motion.velocities, motion.accelerations[:-1], motion.jerks, np.diff(motion.times)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.clip(np.nan_to_num(-a / j), 0.0, t)  # where the velocity is extreme
    inner = np.abs(v[:-1] + turn * (a + turn * j / 2.0))
    fastest = np.maximum(np.maximum(np.abs(v[:-1]), np.abs(v[1:])), inner)
    return np.asarray((fastest <= AT_REST).all(axis=1))
