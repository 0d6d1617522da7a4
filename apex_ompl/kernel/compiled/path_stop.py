"""Soonest stop along the path of a motion, by braking its own time.

The motion goes on unchanged for a time, mostly none; from there on its own time s advances by d_k in the k-th step of
length h, and the joints follow the spline with control points c_k = q(s_k), but for the first three
(:mod:`apex_ompl.kernel.compiled.time_spline`). Each step is the shortest that keeps a share of the joints' limits of
acceleration, |c_k+1 - 2 c_k + c_k-1| <= share a_max h^2, with q(s_k + d) taken as linear in d up to d_k-1. The change
of d_k - d_k-1 is limited by a share of the limits of jerk, so that it is near 0 when d gets there. What breaks a limit
nevertheless is dropped; of several shares and times of going on, the earliest end is taken.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats
from apex_ompl.kernel.compiled.time_spline import (
    keeps_limits,
    path_piece,
    path_value,
    set_start,
    spline_knots,
)

MOST_STEPS = 256
SHARES = ((1.0, 0.7), (0.9, 0.4), (0.6, 0.2), (0.3, 0.1))  # of accelerations, and of jerks
DELAYS = (0.0, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # of going on [s]
CURVING = 0.6  # deviation of a spline per h^2 and acceleration: up to 1/3 at knots, and 1/4 in between
STILL = 1e-12  # motion of a joint in a step that does not count [rad]
SAME_TIME = 1e-9  # [s]
RESTING = 1e-6  # step, in parts of h, that is the last
LEAST_STEPS, SHORTEST = 6, 2e-3  # of a stop, and their length [s]


@inlined
def _step(
    knots: Floats, states: Floats, piece: int, s: float, before: float, braked: float, h: float,
    acceleration: Floats, jerk: Floats, shares: tuple[float, float], control: Floats, k: int, here: Floats,
) -> float:  # fmt: skip
    """Return the length of the step behind control point ``k``, whose place is ``here`` (dof,)."""
    most, least, change = before, 0.0, math.inf
    following = path_piece(knots, s + before, piece)
    for i in range(len(here)):
        there = path_value(knots, states, following, i, s + before)[0]
        move, bend = there - here[i], there - 2.0 * control[k, i] + control[k - 1, i]
        if move < 0.0:
            move, bend = -move, -bend
        if move > STILL:
            room = shares[0] * acceleration[i] * h * h
            most, least = min(most, before * (bend + room) / move), max(least, before * (bend - room) / move)
            change = min(change, before * shares[1] * jerk[i] * h**3 / move)
    if change < math.inf:
        most = min(most, braked + change, change * (math.sqrt(0.25 + 2.0 * before / change) - 0.5))
    return max(before - max(most, least, 0.0), 0.0)


@inlined
def _brake(
    knots: Floats, states: Floats, begin: float, start: Floats, h: float, most: int, lower: Floats, upper: Floats,
    velocity: Floats, acceleration: Floats, jerk: Floats, shares: tuple[float, float],
    control: Floats, here: Floats, deviation: Floats,
) -> int:  # fmt: skip
    """Lay the spline of a motion that brakes; return the number of its last step, or 0 where it breaks a limit."""
    set_start(start, h, control)
    piece = path_piece(knots, begin + h, path_piece(knots, begin, 0))
    for i in range(len(here)):
        here[i] = path_value(knots, states, piece, i, begin + h)[0]
        deviation[i] = 0.0
    s, before, braked, last = begin + h, h, 0.0, 0
    for k in range(2, most):
        length = 0.0
        if last == 0:
            length = _step(knots, states, piece, s, before, braked, h, acceleration, jerk, shares, control, k, here)
            braked, before = before - length, length
            s += length
            piece = path_piece(knots, s, piece)
            if length < RESTING * h or s >= knots[len(knots) - 1]:
                last = k
        for i in range(len(here)):
            place = here[i]
            if last in (0, k):
                here[i] = path_value(knots, states, piece, i, s)[0]
            control[k + 1, i] = here[i]
            if not keeps_limits(control, k - 2, i, h, lower, upper, velocity, acceleration, jerk):
                return 0
            off = (control[k - 1, i] + 4.0 * control[k, i] + control[k + 1, i]) / 6.0 - place
            deviation[i] = max(deviation[i], abs(off))
        if last > 0 and k == last + 2:
            return last
    return 0


@inlined
def _copy(knots: Floats, states: Floats, begin: float, end: float, times: Floats, out: Floats) -> int:
    """Put the knots of a motion from ``begin`` to before ``end`` into place; return their number."""
    piece = path_piece(knots, begin, 0)
    count, time = 0, begin
    while time < end - SAME_TIME:
        times[count] = time - begin
        for i in range(out.shape[2]):
            values = path_value(knots, states, piece, i, time)
            out[0, count, i], out[1, count, i], out[2, count, i] = values
        count += 1
        piece += 1
        time = knots[piece]
    return count


@inlined
def set_place(knots: Floats, states: Floats, time: float, out: Floats) -> None:
    """Put position, velocity and acceleration at a time of a motion into ``out`` (3, dof)."""
    piece = path_piece(knots, time, 0)
    for i in range(out.shape[1]):
        out[0, i], out[1, i], out[2, i] = path_value(knots, states, piece, i, time)


@inlined
def _attempt(
    knots: Floats, states: Floats, begin: float, start: Floats, h: float, most: int, lower: Floats, upper: Floats,
    velocity: Floats, acceleration: Floats, jerk: Floats, shares: tuple[float, float],
    control: Floats, here: Floats, deviation: Floats,
) -> int:  # fmt: skip
    """Set the state at ``begin``, and brake from there; see :func:`_brake`."""
    set_place(knots, states, begin, start)
    return _brake(
        knots, states, begin, start, h, most, lower, upper, velocity, acceleration, jerk, shares, control, here,
        deviation,
    )  # fmt: skip


@inlined
def soonest_stop(
    knots: Floats, states: Floats, begin: float, start: Floats, lower: Floats, upper: Floats, velocity: Floats,
    acceleration: Floats, jerk: Floats, allowed: float, control: Floats, here: Floats, deviation: Floats,
    times: Floats, out: Floats,
) -> int:  # fmt: skip
    """Find the soonest stop along the path of a motion, see :func:`stop_on_path`."""
    dof, end, piece = start.shape[1], knots[len(knots) - 1], path_piece(knots, begin, 0)
    widest, time = 0.0, 0.0
    for i in range(dof):
        widest = max(widest, acceleration[i])
        time = max(time, abs(path_value(knots, states, piece, i, begin)[1]) / acceleration[i])
    h = min(math.sqrt(allowed / (CURVING * widest)), max(time / LEAST_STEPS, SHORTEST))
    best, delay_of, shares_of, last, is_laid = end - begin, -1.0, SHARES[0], 0, False
    for shares in SHARES:
        for delay in DELAYS:
            most = min(int((best - delay) / h) - 1, MOST_STEPS)
            if most < 3 or delay >= delay_of >= 0.0:
                break
            count = _attempt(
                knots, states, begin + delay, start, h, most, lower, upper, velocity, acceleration, jerk, shares,
                control, here, deviation,
            )  # fmt: skip
            is_laid = count > 0
            if is_laid:
                best, delay_of, shares_of, last = delay + (count + 1) * h, delay, shares, count
    if delay_of < 0.0:
        return 0
    if not is_laid:  # another one was tried behind it
        last = _attempt(
            knots, states, begin + delay_of, start, h, MOST_STEPS, lower, upper, velocity, acceleration, jerk,
            shares_of, control, here, deviation,
        )  # fmt: skip
    for i in range(dof):
        curved = acceleration[i]
        for k in range(piece, len(knots)):
            curved = max(curved, abs(states[2, k, i]))
        deviation[i] += h * h / 8.0 * (acceleration[i] + curved)
    copied = _copy(knots, states, begin, begin + delay_of, times, out) if delay_of > 0.0 else 0
    return copied + spline_knots(start, control, last, h, delay_of, times[copied:], out[:, copied:])


@entry_point
def stop_on_path(
    knots: Floats, states: Floats, begin: float, start: Floats, lower: Floats, upper: Floats, velocity: Floats,
    acceleration: Floats, jerk: Floats, allowed: float, control: Floats, here: Floats, deviation: Floats,
    times: Floats, out: Floats,
) -> int:  # fmt: skip
    """Find the soonest stop along the path of a motion that ends at rest.

    Args:
        knots: Times of the motion, shape (K,) [s].
        states: Positions, velocities and accelerations at them, shape (3, K, dof).
        begin: Time from which it stops [s].
        start: Room for a state, shape (3, dof).
        lower: Limits of the joints, shape (dof,); likewise the next four.
        upper: Highest positions.
        velocity: Limits.
        acceleration: Limits.
        jerk: Limits.
        allowed: Largest distance of any joint from the path [rad].
        control: Room, shape (MOST_STEPS + 4, dof).
        here: Room, shape (dof,).
        deviation: Gets a bound on the distance of each joint from the path, shape (dof,) [rad].
        times: Gets the times of the knots, shape (K + MOST_STEPS + 4,) [s].
        out: Gets the states at them, shape (3, K + MOST_STEPS + 4, dof).

    Returns:
        The number of knots; 0 where no stop ends before the motion.
    """
    return int(
        soonest_stop(
            knots, states, begin, start, lower, upper, velocity, acceleration, jerk, allowed, control, here, deviation,
            times, out,
        )
    )  # fmt: skip
