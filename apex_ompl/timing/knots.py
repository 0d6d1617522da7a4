"""Knots of motions: fewer ones, others at given times, and their clock of whole nanoseconds.

A motion of constant jerk between knots is a cubic spline in time. With other knots it is another motion. Here it has
the accelerations of the first one at the new knots, except for a small smooth correction, by which it meets positions
and velocities exactly at the ends of windows of time. Within a window the correction is

    dq''(t) = w tau (1 - tau) (c_1 + c_2 (1 - 2 tau)),   tau = 0..1,

sampled at the knots; it vanishes at the ends, and c_1, c_2 follow from the change of velocity and position. The weight
w is 1, or, near a joint's largest acceleration, falls to almost 0, so that the acceleration stays within its limit.
"""

from __future__ import annotations

import numpy as np

from apex_ompl.types import Array, Flags

NANOSECONDS = 1e9  # in a second
SAME_KNOT = 1e-9  # knots that are nearer to each other than this are one [s]
SAME_TIME = 1e-4  # largest distance of a time from whole nanoseconds, by rounding [ns]
SAME_COUNT = 1e-6  # part of a span that counts as none
LEAST_SPANS = 4  # of a window
NEAR_BOUND = 0.01  # share of the largest acceleration below it, within which the correction vanishes
LEAST_WEIGHT = 1e-8  # of the correction at the largest acceleration, for windows without other knots


def on_grid(times: Array) -> Array:
    """Return times rounded to whole nanoseconds [s]."""
    rounded: Array = np.round(times * NANOSECONDS) / NANOSECONDS
    return rounded


def is_on_grid(times: Array) -> bool:
    """Whether times [s] are whole nanoseconds, except for the rounding of floats."""
    ticks = times * NANOSECONDS
    return bool(np.abs(ticks - np.round(ticks)).max(initial=0.0) <= SAME_TIME)


def union(*times: Array) -> Array:
    """Return the knots of several motions in order, those that are nearly the same once, shape (K,) [s].

    The last one is kept as it is, so that the motion that ends last still ends in its last state.
    """
    found = np.sort(np.concatenate(times))
    kept: Array = found[np.append(True, np.diff(found) > SAME_KNOT)]
    if len(kept) > 1:
        kept[-1] = found[-1]
    return kept


def spaced(times: Array, spacing: float) -> Array:
    """Return times of knots in whole nanoseconds, at least ``spacing`` apart, by those of other knots [s].

    A knot that is nearer to the one before it is moved to that distance, so that the jerk still changes between two
    near knots; one that is then between knots is left out. Both ends are kept. There are four spans or more.
    """
    grid = on_grid(times)
    found, least = [float(grid[0])], spacing - SAME_TIME / NANOSECONDS
    end = float(grid[-1])
    for time in grid[1:-1].tolist():
        if time > found[-1] and end - time > 0.0:
            found.append(max(time, found[-1] + spacing))
    while len(found) > 1 and end - found[-1] < least:
        found.pop()
    array = np.array([*found, end])
    while len(array) <= LEAST_SPANS:
        array = np.sort(np.append(array, (array[:-1] + array[1:]) / 2.0))
    return on_grid(array)


def even_times(duration: float, rate: float) -> Array:
    """Return times at a rate from 0 on, and the end, one to two spacings after the last of them, in whole nanoseconds.

    There are four spans or more, nearer ones in a short motion.

    Args:
        duration: The end [s].
        rate: Knots a second [Hz].
    """
    count = int(duration * rate + SAME_COUNT)
    spacing = 1.0 / rate if count >= LEAST_SPANS else duration / LEAST_SPANS
    return on_grid(np.append(spacing * np.arange(max(count, LEAST_SPANS)), duration))


def removable(accelerations: Array, times: Array, tolerance: Array) -> Flags:
    """Return which knots can be left out, no two neighbors, shape (K,).

    At these the accelerations of all joints are on the line between the neighboring knots.

    Args:
        accelerations: At the knots, shape (K, dof) [rad/s^2].
        times: Of the knots, shape (K,) [s].
        tolerance: Largest distance from the line, shape (dof,) [rad/s^2].
    """
    before, after = times[1:-1] - times[:-2], times[2:] - times[1:-1]
    share = (before / (before + after))[:, None]
    line = (1.0 - share) * accelerations[:-2] + share * accelerations[2:]
    straight: list[bool] = np.all(np.abs(accelerations[1:-1] - line) <= tolerance, axis=1).tolist()
    found, last = np.zeros(len(times), bool), False
    for k, flag in enumerate(straight, 1):
        found[k] = last = flag and not last
    return found


def windows(times: Array, window: float) -> list[int]:
    """Return the indices of the knots at the ends of windows of time, each of at least four spans.

    Args:
        times: Of the knots, shape (K,), at least four spans [s].
        window: Least length of a window [s].
    """
    last = len(times) - 1
    ends = [0]
    while ends[-1] < last:
        k = max(int(np.searchsorted(times, times[ends[-1]] + window)), ends[-1] + LEAST_SPANS)
        ends.append(k if last - k >= LEAST_SPANS and times[last] - times[k] >= window / 2.0 else last)
    return ends


def refitted(states: Array, times: Array, window: float, bounds: Array | None = None) -> Array:
    """Return the states of the motion with knots at given times that follows another motion, shape (3, K, dof).

    Args:
        states: Positions, velocities and accelerations of the other motion at the knots, shape (3, K, dof).
        times: Of the knots, shape (K,), at least four spans [s].
        window: Least length of the windows at whose ends both motions have the same state [s].
        bounds: Largest accelerations, near which there is next to no correction, shape (dof,) [rad/s^2].
    """
    q, v, a = states.copy()
    ends = windows(times, window)
    first, last = np.array(ends[:-1]), np.array(ends[1:])
    of_knot = np.minimum(np.searchsorted(last, np.arange(len(times)), side="right"), len(first) - 1)
    h, left = np.diff(times)[:, None], (times[last][of_knot[:-1]] - times[1:])[:, None]
    since, length = times - times[first][of_knot], (times[last] - times[first])[of_knot]

    def gains(velocity: Array, position: Array) -> tuple[Array, Array]:
        """Return the changes of velocity and position over each window by those over the spans."""
        return np.add.reduceat(velocity, first, axis=0), np.add.reduceat(position + left * velocity, first, axis=0)

    def integrals(rates: Array) -> tuple[Array, Array]:
        """Return the changes of velocity and position over the spans by accelerations at the knots."""
        return h * (rates[:-1] + rates[1:]) / 2.0, h * h * (2.0 * rates[:-1] + rates[1:]) / 6.0

    speed, place = integrals(a)
    missing = gains(np.diff(v, axis=0) - speed, np.diff(q, axis=0) - h * v[:-1] - place)
    tau = (since / length)[:, None]
    even = tau * (1.0 - tau)
    even[ends] = 0.0
    if bounds is not None:
        room = (1.0 - np.abs(a) / np.maximum(bounds, np.finfo(float).tiny)) / NEAR_BOUND
        even = even * np.clip(room, LEAST_WEIGHT, 1.0)
    odd = even * (1.0 - 2.0 * tau)
    (a11, a21), (a12, a22) = gains(*integrals(even)), gains(*integrals(odd))
    determinant = a11 * a22 - a12 * a21
    c1 = (missing[0] * a22 - missing[1] * a12) / determinant
    c2 = (missing[1] * a11 - missing[0] * a21) / determinant
    a += even * c1[of_knot] + odd * c2[of_knot]
    speed, place = integrals(a)
    for begin, end in zip(first.tolist(), last.tolist(), strict=True):  # the states at both are exact
        inner = slice(begin + 1, end)
        v[inner] = v[begin] + np.cumsum(speed[begin : end - 1], axis=0)
        moved = h[begin : end - 1] * v[begin : end - 1] + place[begin : end - 1]
        q[inner] = q[begin] + np.cumsum(moved, axis=0)
    return np.stack([q, v, a])
