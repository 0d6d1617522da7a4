"""Rests of motions: when no joint moves, and motions that are brought to rest along their paths."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.moving import LimitArrays, follow_profile
from apex_ompl.robot.model import Limits
from apex_ompl.timing.trajectory import Trajectory, joined
from apex_ompl.types import Array, Flags

AT_REST = 1e-6
"""Largest velocity of a joint at rest [rad/s]."""
SPACING = 0.008  # of knots where a motion comes to rest [s]
COMING = (0.2, 0.3, 0.45, 0.7, 1.0, 1.5)  # times in which it does [s]
SLOWER = tuple(1.25**k for k in range(32))  # factors of its duration
DEVIATION = 2e-3  # from the path [rad]


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


def from_rest_to_rest(
    motion: Trajectory, start: float, end: float, limits: Limits
) -> tuple[Trajectory, Array, Array]:  # fmt: skip
    """Return the part of a motion between two times, along its path and at rest at both ends.

    Where the motion is not at rest there, its rate falls to 0 and rises from it as a polynomial of degree 5; where that
    keeps the limits at no length of the fall, the whole part is slower. It is at most 2 mrad from the path.

    Args:
        motion: The motion.
        start: Where the part starts [s].
        end: Where it ends [s].
        limits: Limits of the joints, which the motion keeps.

    Returns:
        The part, times of the motion, shape (N,) [s], and when the part is there, shape (N,) [s].

    Raises:
        ParameterError: No part was found that keeps the limits.
    """
    part = motion.before(end).after(start)
    first, last = (not is_at_rest(part, time) for time in (0.0, part.duration))
    if not first and not last:
        return part, np.array([start, end]), np.array([0.0, part.duration])
    for factor, coming in product(SLOWER, COMING):
        made = _brought_to_rest(part.slower(factor), coming, (first, last), LimitArrays.of(limits))
        if made is not None:
            return made[0], start + made[1] / factor, made[2]
    raise ParameterError("motion", f"{start:.3f} s to {end:.3f} s", "a part that can come to rest within the limits")


def _brought_to_rest(
    part: Trajectory, coming: float, ends: tuple[bool, bool], limits: LimitArrays
) -> tuple[Trajectory, Array, Array] | None:
    """Return a motion that is brought to rest at its ends, and its places and times, or None.

    Args:
        part: The motion.
        coming: The time in which it is [s].
        ends: Whether it is at its start and at its end.
        limits: Limits of the joints.
    """
    first, last = (0.5 * coming * one for one in ends)
    last = part.duration - last
    if first > last:
        return None
    pieces, places, times = [part.before(last).after(first)], [first, last], [0.0, last - first]
    if ends[0]:
        stop = _stop(_reversed(part), part.duration - first, coming, limits)
        if stop is None:
            return None
        pieces, places = [_reversed(stop[0]), *pieces], [*(part.duration - stop[1][::-1]), *places]
        times = [*(stop[2][-1] - stop[2][::-1]), *(stop[2][-1] + time for time in times)]
    if ends[1]:
        stop = _stop(part, last, coming, limits)
        if stop is None:
            return None
        pieces, places, times = [*pieces, stop[0]], [*places, *stop[1]], [*times, *(times[-1] + stop[2])]
    return joined([one for one in pieces if one.duration > 0.0]), np.array(places), np.array(times)


def _stop(
    motion: Trajectory, since: float, lasting: float, limits: LimitArrays
) -> tuple[Trajectory, Array, Array] | None:
    """Return the end of a motion from a time on, slower and slower to its rest, its places and their times, or None."""
    steps = math.ceil(lasting / SPACING)
    u = np.arange(steps + 1) / steps
    places = since + lasting * (u - u**4 * (2.5 + u * (u - 3.0)))  # integral of 1 - 10 u^3 + 15 u^4 - 6 u^5
    places[-1] = motion.duration
    states = np.stack([motion.positions, motion.velocities, motion.accelerations])
    found = follow_profile(motion.times, states, since, places, lasting / steps, limits)
    if found is None or found[2].max() > DEVIATION:
        return None
    return Trajectory.unchecked(*found[:2], motion.joint_names), np.append(places, places[-1]), found[0]


def _reversed(motion: Trajectory) -> Trajectory:
    """Return a motion from its end to its start."""
    q, v, a = motion.positions[::-1], -motion.velocities[::-1], motion.accelerations[::-1]
    return Trajectory.unchecked(
        motion.duration - motion.times[::-1], np.ascontiguousarray([q, v, a]), motion.joint_names
    )  # fmt: skip
