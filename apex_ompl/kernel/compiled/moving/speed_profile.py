"""Profiles of speed along a path: their bounds, places over time, motions in joint space, and what blocks them.

A profile goes along the stages of :mod:`apex_ompl.kernel.compiled.moving.speed_search`.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.moving.time_spline import keeps_limits, path_piece, path_value, set_start, spline_knots

STILL = 1e-9  # |q'| below which a joint does not move along the path


@inlined
def _bounds(
    rates: Floats, velocity: Floats, acceleration: Floats, jerk: Floats, spacing: float, window: float, x: float, p: int
) -> tuple[float, float]:
    """Return the bounds of :func:`push_bounds` at a place and a level."""
    last, root = rates.shape[1] - 1, math.sqrt(x)
    low, high = -1e9, 1e9
    for i in range(len(velocity)):
        slope, bend = rates[0, p, i], rates[1, p, i]
        if slope < 0.0:
            slope, bend = -slope, -bend
        change = abs(rates[1, min(p + 1, last), i] - rates[1, max(p - 1, 0), i]) / (2.0 * spacing)
        most = acceleration[i]
        if x > 1.0:
            if slope * root > velocity[i] or abs(bend) * x > most or change * x * root > jerk[i]:
                return 1.0, -1.0
        else:
            most = max(most, abs(bend) * x)
        if slope > STILL:
            low, high = max(low, (-most - bend * x) / slope), min(high, (most - bend * x) / slope)
        side = min(window * jerk[i] / max(slope, STILL), jerk[i] / (6.0 * root * abs(bend) + STILL))
        low, high = max(low, -side), min(high, side)
    return low, high


@entry_point
def push_bounds(
    rates: Floats, velocity: Floats, acceleration: Floats, jerk: Floats, spacing: float, window: float, x: Floats,
    lowest: Floats, highest: Floats,
) -> None:  # fmt: skip
    """Find the least and largest d^2s/dt^2 at places of a path for each level of x.

    The motion itself, d^2s/dt^2 = 0 at x = 1, and slower ones stay allowed also where they exceed the limits given. The
    jerk has three terms, with x^3/2, with 3 q'' x^1/2 d^2s/dt^2, and with q' d^3s/dt^3. Each is bounded by itself: the
    first by the limit, the second by half of it, and the third by a d^2s/dt^2 that may change within a window in time.

    Args:
        rates: q' and q'' at the places, shape (2, P, dof).
        velocity: Limits, shape (dof,).
        acceleration: Limits, shape (dof,).
        jerk: Limits, shape (dof,).
        spacing: Of the places [s].
        window: See above [s].
        x: Levels of the squared rate, shape (levels,).
        lowest: Gets the least ones, shape (P, levels) [1/s].
        highest: Gets the largest, shape (P, levels) [1/s]; less than the least where there is none.
    """
    for p in range(lowest.shape[0]):
        for m in range(len(x)):
            lowest[p, m], highest[p, m] = _bounds(rates, velocity, acceleration, jerk, spacing, window, x[m], p)


@inlined
def _place_after(x: Floats, i: int, j: int, length: float, since: float) -> float:
    """Return how far along a stage a profile is at a time since its start."""
    if i == 0 and j == 0:
        push, half = x[1] / length, length / math.sqrt(x[1])
        along = 0.5 * push * since * since if since <= half else length - 0.5 * push * (2.0 * half - since) ** 2
        return float(along if since < 2.0 * half else length)
    return float(since * (math.sqrt(x[i]) + since * (x[j] - x[i]) / (4.0 * length)))


@entry_point
def profile_places(
    x: Floats, length: float, first: float, levels: Integers, departures: Floats, start: float, h: float, out: Floats
) -> None:
    """Put the places of a profile at times ``start + k h`` into ``out`` (N,).

    Args:
        x: Levels of the squared rate, shape (levels,).
        length: Of a stage [s].
        first: Place of the first point [s].
        levels: Levels at the points, shape (S + 1,).
        departures: Times of arrival at them and of departure, shape (S + 1, 2) [s].
        start: First time [s].
        h: Spacing of the times [s].
        out: Gets the places [s].
    """
    k, last = 0, len(levels) - 1
    for n in range(len(out)):
        time = start + n * h
        while k < last and departures[k + 1, 0] <= time:
            k += 1
        out[n] = first + k * length
        if k < last and time > departures[k, 1]:
            along = _place_after(x, levels[k], levels[k + 1], length, time - departures[k, 1])
            out[n] += min(max(along, 0.0), length)


@entry_point
def follow_profile(
    knots: Floats, states: Floats, place: float, profile: Floats, h: float,
    lower: Floats, upper: Floats, velocity: Floats, acceleration: Floats, jerk: Floats,
    start: Floats, control: Floats, deviation: Floats, times: Floats, out: Floats,
) -> int:  # fmt: skip
    """Make the motion along a path that has the places of a profile, from the path's own state to rest.

    Args:
        knots: The path's own times, shape (K,) [s].
        states: Positions, velocities and accelerations at them, shape (3, K, dof).
        place: Place at the start, which is passed at rate 1 or at rest [s].
        profile: Places at times h apart, the last at rest, shape (N + 1,), N > 1.
        h: Spacing in time [s].
        lower: Lowest positions, shape (dof,) [rad].
        upper: Highest positions, shape (dof,) [rad].
        velocity: Limits of velocity, shape (dof,) [rad/s].
        acceleration: Limits of acceleration, shape (dof,) [rad/s^2].
        jerk: Limits of jerk, shape (dof,) [rad/s^3].
        start: Buffer, shape (3, dof).
        control: Buffer, shape (N + 4, dof).
        deviation: Gets the largest distance of its knots from the places of the profile, of each joint, shape (dof,).
        times: Gets the times of its knots, shape (N + 2,) [s].
        out: Gets the states at them, shape (3, N + 2, dof).

    Returns:
        The number of knots; 0 where it breaks a limit.
    """
    dof, count = start.shape[1], len(profile) - 1
    piece = path_piece(knots, place, 0)
    for i in range(dof):
        start[0, i], start[1, i], start[2, i] = path_value(knots, states, piece, i, place)
        deviation[i] = 0.0
    set_start(start, h, control)
    before = path_piece(knots, profile[1], piece)
    for r in range(3, count + 4):
        s = profile[min(r - 1, count)]
        piece = path_piece(knots, s, piece)
        for i in range(dof):
            control[r, i] = path_value(knots, states, piece, i, s)[0]
            if not keeps_limits(control, r - 3, i, h, lower, upper, velocity, acceleration, jerk):
                return 0
            if r - 2 <= count:
                there = path_value(knots, states, before, i, profile[r - 2])[0]
                off = (control[r - 2, i] + 4.0 * control[r - 1, i] + control[r, i]) / 6.0 - there
                deviation[i] = max(deviation[i], abs(off))
        before = piece
    return spline_knots(start, control, count, h, 0.0, times, out)


@inlined
def _blocked(spans: Floats, count: int, first: float, last: float) -> bool:
    """Whether any interval meets another one."""
    for n in range(count):
        if spans[n, 0] <= last and spans[n, 1] >= first:
            return True
    return False


@entry_point
def first_blocked(
    places: Floats, spans: Floats, counts: Integers, points: Floats, point_spans: Floats, point_counts: Integers,
    profile: Floats, start: float, h: float,
) -> int:  # fmt: skip
    """Return the first step of a profile in which it may be at a place that is blocked, or -1.

    Args:
        places: Starts and ends of the pieces of the path, shape (P, 2) [s].
        spans: Their blocked intervals, shape (P, MOST_SPANS, 2) [s].
        counts: Their numbers, shape (P,).
        points: Places of which there are intervals, too, increasing, shape (S + 1,) [s].
        point_spans: Those, shape (S + 1, MOST_SPANS, 2) [s].
        point_counts: Their numbers, shape (S + 1,).
        profile: Places at times h apart, shape (N,) [s].
        start: Time of the first [s].
        h: Spacing in time [s].
    """
    p = k = 0
    for n in range(len(profile) - 1):
        first, last = profile[n], profile[n + 1]
        while k + 1 < len(points) and points[k] < first:
            k += 1
        if points[k] == first == last:
            if _blocked(point_spans[k], point_counts[k], start + n * h, start + (n + 1) * h):
                return n
            continue
        while p + 1 < len(places) and places[p, 1] <= first:
            p += 1
        r = p
        while r < len(places) and places[r, 0] < last:
            if _blocked(spans[r], counts[r], start + n * h, start + (n + 1) * h):
                return n
            r += 1
    return -1
