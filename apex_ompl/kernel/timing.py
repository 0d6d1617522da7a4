"""Motions over time: cubic pieces between knots, profiles of constant jerk, and time parameterization of curves.

``Knots`` are the times of a motion's knots, shape (K,) [s], and positions, velocities and accelerations at them, each
of shape (K, dof) [rad, rad/s, rad/s^2]; the jerk is constant in between.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.timing import cubic_pieces, jerk_profiles, time_parameterization
from apex_ompl.types import Array

Knots = tuple[Array, Array, Array, Array]

MOST_SPEED = 1e12  # squared, of curves without a limit [rad^2/s^2]
TICK = jerk_profiles.TICK  # to which profiles' times are rounded [s]


def sample_motion(knots: Knots, times: Array, order: int = 0, count: int = 1) -> Array:
    """Return some derivatives of a motion, one after the other, shape (count, N, dof).

    Before 0 and after the end the robot stands still.

    Args:
        knots: The motion.
        times: Shape (N,) [s].
        order: First derivative, 0 to 3; positions are 0.
        count: How many.
    """
    out = np.empty((count, len(times), knots[1].shape[1]))
    cubic_pieces.sample_motion(*knots, times, order, out)
    return out


def motion_extremes(knots: Knots) -> Array:
    """Return the extremes of a motion, which are those between knots, too, shape (5, dof).

    They are the least and largest positions, and the largest velocities, accelerations and jerks.
    """
    found = np.empty((5, knots[1].shape[1]))
    cubic_pieces.motion_extremes(*knots, found)
    return found


def relative_gap(knots: Knots) -> float:
    """Return the largest error of positions and velocities integrated from the knot before, relative to at least 1."""
    return float(cubic_pieces.relative_gap(*knots))


def cubic_rates(knots: Knots) -> tuple[Array, float]:
    """Return velocities and accelerations side by side, shape (K, 2 dof), and the sum of the gaps of the pieces [rad].

    Args:
        knots: The motion, of two or more knots.
    """
    rates = np.empty((len(knots[0]), 2 * knots[1].shape[1]))
    return rates, cubic_pieces.cubic_rates(*knots, rates)


def join_profiles(phases: Array, jerks: Array, starts: Integers, states: Array) -> tuple[Array, Array]:
    """Join the jerk profiles of state-to-state problems to a motion whose knots are where the jerk of a joint changes.

    Args:
        phases: Durations of the phases of each problem and joint, shape (K, dof, P) [s].
        jerks: Jerks in them, shape (K, dof, P) [rad/s^3].
        starts: Times at which the problems start and the last one ends, shape (K + 1,) [ticks].
        states: Positions, velocities and accelerations between which they go, shape (3, K + 1, dof).

    Returns:
        Times, shape (knots,) [s], and positions, velocities and accelerations at them, shape (3, knots, dof).
    """
    problems, dof, count = phases.shape
    shape = problems, dof, count + jerk_profiles.SPLITS - 1
    room = np.empty(shape, np.int64), np.empty((4, *shape)), np.empty(dof * shape[2], np.int64)
    times = np.empty(math.prod(shape) + 1)
    knots = np.empty((3, len(times), dof))
    found = jerk_profiles.join_profiles(phases, jerks, starts, np.ascontiguousarray(states), *room, times, knots)
    return times[:found].copy(), knots[:, :found].copy()


class PathRows(NamedTuple):
    """Limits low <= slope u + bend x <= high along a curve q(s), with x = (ds/dt)^2 and u = d^2s/dt^2.

    Attributes:
        slope: At evenly spaced points of the curve, shape (n, rows).
        bend: Shape (n, rows).
        low: Not positive, shape (n, rows).
        high: Not negative, shape (n, rows).
        most: Bounds on x, shape (n,) [rad^2/s^2].
    """

    slope: Array
    bend: Array
    low: Array
    high: Array
    most: Array


def max_path_speeds(
    first: Array, second: Array, velocity: Array, acceleration: Array, step: float, more: PathRows | None = None
) -> Array:
    """Return the largest squared speeds (ds/dt)^2 along a curve q(s), from rest to rest, shape (n,) [rad^2/s^2].

    Args:
        first: Derivatives q' by arc length at evenly spaced points, shape (n, dof).
        second: Derivatives q'', shape (n, dof) [1/rad].
        velocity: Limits, shape (dof,) [rad/s].
        acceleration: Limits, shape (dof,) [rad/s^2].
        step: Spacing of the points along the curve [rad].
        more: Further limits at the points.
    """
    high = np.tile(acceleration, (len(first), 1))
    rows = PathRows(first, second, -high, high, np.full(len(first), MOST_SPEED))
    if more is not None:
        slope, bend = np.hstack([first, more.slope]), np.hstack([second, more.bend])
        low, high = np.hstack([-high, more.low]), np.hstack([high, more.high])
        rows = PathRows(slope, bend, low, high, np.minimum(more.most, MOST_SPEED))
        velocity = np.append(velocity, np.full(more.slope.shape[1], np.inf))
    time_parameterization.max_path_speeds(rows.slope, rows.bend, velocity, rows.low, rows.high, step, rows.most)
    return rows.most


def curve_duration(squared_speeds: Array, step: float) -> float:
    """Return the duration of a motion along a curve [s].

    Args:
        squared_speeds: At evenly spaced points, linear in between, shape (n,) [rad^2/s^2].
        step: Spacing of the points [rad].
    """
    return float(time_parameterization.sample_times(squared_speeds, step, 0.0, np.empty(0)))


def arc_lengths(squared_speeds: Array, step: float, spacing: float, count: int) -> Array:
    """Return the arc lengths at ``count`` times of a motion along a curve, the first at time 0, shape (count,) [rad].

    Args:
        squared_speeds: At evenly spaced points, linear in between, shape (n,) [rad^2/s^2].
        step: Spacing of the points [rad].
        spacing: Time step [s].
        count: Number of times.
    """
    arc = np.empty(count)
    time_parameterization.sample_times(squared_speeds, step, spacing, arc)
    return arc


def max_distance(points: Array, places: Array, path: Array, arc: Array, window: float) -> float:
    """Return the largest distance of points from a polyline, each from the part near its own arc length [rad].

    Args:
        points: Shape (N, dof).
        places: Their arc lengths, ascending, shape (N,) [rad].
        path: States of the polyline, two or more, shape (M, dof).
        arc: Arc lengths of its states, shape (M,) [rad].
        window: Half length of that part [rad].
    """
    return float(time_parameterization.max_distance(points, places, path, arc, window))
