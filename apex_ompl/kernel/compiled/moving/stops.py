"""Soonest stops: of each joint by itself, in closed form, and along the path of a motion, by braking its own time.

Joint by joint: from velocity v and acceleration a, within |a| <= A and |jerk| <= J, the soonest stop has three phases
of jerk -J, 0 and J (mirrored where v + a |a| / (2 J), the velocity left when a has been brought to 0, is negative).
With p = min(sqrt(J v + a^2 / 2), A) the acceleration goes from a to -p, stays there, and returns to 0:

    t1 = (a + p) / J,   t2 = (v + a^2 / (2 J)) / p - p / J,   t3 = p / J.

This is the problem of Ruckig's velocity interface (Berscheid and Kroeger 2021), which tests compare it with. That stop
ends braking early so as to rest with both v and a at 0; where it would pass a position limit, braking goes on for as
short a time as keeps the limit, until v = 0 at the latest, and the joint swings back.

Along the path: the motion goes on unchanged for a time, mostly none. Then its own time s advances by d_k in
the k-th step of length h, and the joints follow the spline with control points c_k = q(s_k), but for the first three
(:mod:`apex_ompl.kernel.compiled.moving.time_spline`). Each step is the shortest that keeps a share of the joints'
limits of acceleration, |c_k+1 - 2 c_k + c_k-1| <= share a_max h^2, with q(s_k + d) taken as linear in d up to d_k-1.
The change of d_k - d_k-1 is limited by a share of the limits of jerk, so that it is near 0 when d gets there. A stop
that breaks a limit nevertheless is dropped; of several shares and times of going on, the earliest end is taken.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats
from apex_ompl.kernel.compiled.moving.time_spline import (
    keeps_limits,
    path_piece,
    path_value,
    set_start,
    spline_knots,
)

PHASES = 5  # of a stop: two of braking on, and three of the soonest stop from there
SAME_KNOT = 1e-10  # times between which there is one knot [s]
JERK_SHARE = 1.0 - 2e-8  # of the limit, for rounding between knots that are near each other
LIMIT_TOLERANCE = 1e-9  # by which a position limit may be passed, by rounding [rad]
HALVINGS = 40


@inlined
def moved(q: float, v: float, a: float, j: float, t: float) -> tuple[float, float, float]:
    """Return position, velocity and acceleration after a time ``t`` of jerk ``j``."""
    return q + t * (v + t * (a / 2.0 + t * j / 6.0)), v + t * (a + t * j / 2.0), a + t * j


@inlined
def widened(low: float, high: float, q: float, v: float, a: float, j: float, t: float) -> tuple[float, float]:
    """Return a range of positions, extended to those of a time ``t`` of jerk ``j``."""
    end = moved(q, v, a, j, t)[0]
    low, high = min(low, q, end), max(high, q, end)
    if j == 0.0:
        first = second = -v / a if a != 0.0 else -1.0
    else:
        side = a * a - 2.0 * j * v
        if side < 0.0:
            return low, high
        side = math.sqrt(side)
        first, second = (-a + side) / j, (-a - side) / j
    for turn in (first, second):
        if 0.0 < turn < t:
            there = moved(q, v, a, j, turn)[0]
            low, high = min(low, there), max(high, there)
    return low, high


@inlined
def _set_soonest(v: float, a: float, most: float, jerk: float, first: int, lengths: Floats, jerks: Floats) -> None:
    """Set the three phases of the soonest stop, from the phase ``first`` on."""
    sign = 1.0 if v + a * abs(a) / (2.0 * jerk) >= 0.0 else -1.0
    v, a = sign * v, sign * a
    peak = math.sqrt(max(jerk * v + 0.5 * a * a, 0.0))
    plateau, most = 0.0, max(most, -a)
    if peak > most:
        plateau = (v + 0.5 * a * a / jerk) / most - most / jerk
        peak = most
    lengths[first], jerks[first] = max(a + peak, 0.0) / jerk, -sign * jerk
    lengths[first + 1], jerks[first + 1] = max(plateau, 0.0), 0.0
    lengths[first + 2], jerks[first + 2] = peak / jerk, sign * jerk


@inlined
def _range(q: float, v: float, a: float, lengths: Floats, jerks: Floats) -> tuple[float, float]:
    """Return the least and largest position of a motion in phases."""
    low = high = q
    for p in range(PHASES):
        low, high = widened(low, high, q, v, a, jerks[p], lengths[p])
        q, v, a = moved(q, v, a, jerks[p], lengths[p])
    return low, high


@inlined
def _set_braking(
    q: float, v: float, a: float, most: float, jerk: float, sign: float, time: float, lengths: Floats, jerks: Floats
) -> None:
    """Set all phases of a stop that brakes as hard as can be for a time, against motion in the direction ``sign``."""
    ramp = max(sign * a + most, 0.0) / jerk
    lengths[0], jerks[0] = min(time, ramp), -sign * jerk
    lengths[1], jerks[1] = max(time - ramp, 0.0), 0.0
    for p in range(2):
        q, v, a = moved(q, v, a, jerks[p], lengths[p])
    _set_soonest(v, a, most, jerk, 2, lengths, jerks)


@inlined
def _longest_braking(v: float, a: float, most: float, jerk: float) -> float:
    """Return the time after which braking as hard as can be ends at v = 0, the motion being in positive direction."""
    ramp = max(a + most, 0.0) / jerk
    left = moved(0.0, v, a, -jerk, ramp)[1]
    if left > 0.0:
        return ramp + left / most
    return (a + math.sqrt(max(a * a + 2.0 * jerk * v, 0.0))) / jerk


@inlined
def _set_stop(
    q: float, v: float, a: float, lower: float, upper: float, most: float, jerk: float, lengths: Floats, jerks: Floats
) -> float:
    """Set the phases of a joint's soonest stop within its position limits, or of its soonest stop where none is.

    Returns:
        How far the stop passes a position limit, 0 where it does not.
    """
    lengths[0] = lengths[1] = jerks[0] = jerks[1] = 0.0
    _set_soonest(v, a, most, jerk, 2, lengths, jerks)
    low, high = _range(q, v, a, lengths, jerks)
    beyond = max(high - upper, lower - low)
    if beyond <= LIMIT_TOLERANCE:
        return max(beyond, 0.0)
    sign = 1.0 if high - upper >= lower - low else -1.0
    most = max(most, -sign * a)
    shortest, longest = 0.0, _longest_braking(sign * v, sign * a, most, jerk)
    for k in range(HALVINGS):
        time = longest if k == 0 else 0.5 * (shortest + longest)
        _set_braking(q, v, a, most, jerk, sign, time, lengths, jerks)
        low, high = _range(q, v, a, lengths, jerks)
        if max(high - upper, lower - low) <= LIMIT_TOLERANCE:
            longest = time
        elif k == 0:
            lengths[0] = lengths[1] = 0.0
            _set_soonest(v, a, most, jerk, 2, lengths, jerks)
            return beyond
        else:
            shortest = time
    _set_braking(q, v, a, most, jerk, sign, longest, lengths, jerks)
    return 0.0


@inlined
def _sorted_times(lengths: Floats, times: Floats) -> int:
    """Put the times at which a phase of any joint ends into ``times``, 0 first, each once; return their number."""
    last = 0.0
    for i in range(lengths.shape[0]):
        end = 0.0
        for p in range(PHASES):
            end += lengths[i, p]
        last = max(last, end)
    count = 1
    times[0] = 0.0
    for i in range(lengths.shape[0]):
        end = 0.0
        for p in range(PHASES):
            end += lengths[i, p]
            at = count
            while times[at - 1] > end:
                at -= 1
            if end - times[at - 1] <= SAME_KNOT or (at < count and times[at] - end <= SAME_KNOT):
                continue
            if last - end <= SAME_KNOT:
                continue
            for k in range(count, at, -1):
                times[k] = times[k - 1]
            times[at] = end
            count += 1
    if last > 0.0:
        times[count] = last
        count += 1
    return count


@inlined
def soonest_stops(
    q: Floats, v: Floats, a: Floats, lower: Floats, upper: Floats, acceleration: Floats, jerk: Floats,
    lengths: Floats, jerks: Floats, times: Floats, knots: Floats, beyond: Floats,
) -> int:  # fmt: skip
    """Stop every joint as soon as it can; see :func:`stop_joints`."""
    for i in range(len(q)):
        most = acceleration[i]
        beyond[i] = _set_stop(q[i], v[i], a[i], lower[i], upper[i], most, JERK_SHARE * jerk[i], lengths[i], jerks[i])
    count = _sorted_times(lengths, times)
    for i in range(len(q)):
        k, when = 0, 0.0
        x, y, z = q[i], v[i], a[i]
        for p in range(PHASES):
            while k < count and times[k] < when + lengths[i, p]:
                since = max(times[k] - when, 0.0)
                knots[0, k, i], knots[1, k, i], knots[2, k, i] = moved(x, y, z, jerks[i, p], since)
                k += 1
            x, y, z = moved(x, y, z, jerks[i, p], lengths[i, p])
            when += lengths[i, p]
        for rest in range(k, count):
            knots[0, rest, i], knots[1, rest, i], knots[2, rest, i] = x, 0.0, 0.0
    return count


@entry_point
def stop_joints(
    q: Floats, v: Floats, a: Floats, lower: Floats, upper: Floats, acceleration: Floats, jerk: Floats,
    lengths: Floats, jerks: Floats, times: Floats, knots: Floats, beyond: Floats,
) -> int:  # fmt: skip
    """Stop every joint as soon as it can; each by itself.

    Args:
        q: Positions, shape (dof,) [rad].
        v: Velocities, shape (dof,) [rad/s].
        a: Accelerations, shape (dof,) [rad/s^2].
        lower: Lowest positions, shape (dof,) [rad].
        upper: Highest positions, shape (dof,) [rad].
        acceleration: Limits of acceleration, shape (dof,) [rad/s^2].
        jerk: Limits of jerk, shape (dof,) [rad/s^3].
        lengths: Buffer for the lengths of the phases, shape (dof, PHASES) [s].
        jerks: Buffer for the jerks in them, shape (dof, PHASES) [rad/s^3].
        times: Gets the times at which the jerk of any joint changes, shape (dof PHASES + 1,) [s].
        knots: Gets positions, velocities and accelerations at them, shape (3, that, dof).
        beyond: Gets how far each joint passes a position limit, shape (dof,) [rad].

    Returns:
        The number of knots.
    """
    return int(soonest_stops(q, v, a, lower, upper, acceleration, jerk, lengths, jerks, times, knots, beyond))


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
    """Return the length of the step after control point ``k``, whose place is ``here`` (dof,)."""
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
    knots: Floats, states: Floats, when: float, start: Floats, h: float, most: int, lower: Floats, upper: Floats,
    velocity: Floats, acceleration: Floats, jerk: Floats, shares: tuple[float, float],
    control: Floats, here: Floats, deviation: Floats,
) -> int:  # fmt: skip
    """Lay the spline of a motion that brakes; return the number of its last step, or 0 where it breaks a limit."""
    set_start(start, h, control)
    piece = path_piece(knots, when + h, path_piece(knots, when, 0))
    for i in range(len(here)):
        here[i] = path_value(knots, states, piece, i, when + h)[0]
        deviation[i] = 0.0
    s, before, braked, last = when + h, h, 0.0, 0
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
def _copy(knots: Floats, states: Floats, when: float, end: float, times: Floats, out: Floats) -> int:
    """Put the knots of a motion from ``when`` to before ``end`` into place; return their number."""
    piece = path_piece(knots, when, 0)
    count, time = 0, when
    while time < end - SAME_TIME:
        times[count] = time - when
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
    knots: Floats, states: Floats, when: float, start: Floats, h: float, most: int, lower: Floats, upper: Floats,
    velocity: Floats, acceleration: Floats, jerk: Floats, shares: tuple[float, float],
    control: Floats, here: Floats, deviation: Floats,
) -> int:  # fmt: skip
    """Set the state at ``when``, and brake from there; see :func:`_brake`."""
    set_place(knots, states, when, start)
    return _brake(
        knots, states, when, start, h, most, lower, upper, velocity, acceleration, jerk, shares, control, here,
        deviation,
    )  # fmt: skip


@inlined
def soonest_stop(
    knots: Floats, states: Floats, when: float, start: Floats, lower: Floats, upper: Floats, velocity: Floats,
    acceleration: Floats, jerk: Floats, allowed: float, control: Floats, here: Floats, deviation: Floats,
    times: Floats, out: Floats,
) -> int:  # fmt: skip
    """Find the soonest stop along the path of a motion, see :func:`stop_on_path`."""
    dof, end, piece = start.shape[1], knots[len(knots) - 1], path_piece(knots, when, 0)
    widest, time = 0.0, 0.0
    for i in range(dof):
        widest = max(widest, acceleration[i])
        time = max(time, abs(path_value(knots, states, piece, i, when)[1]) / acceleration[i])
    h = min(math.sqrt(allowed / (CURVING * widest)), max(time / LEAST_STEPS, SHORTEST))
    best, delay_of, shares_of, last, is_laid = end - when, -1.0, SHARES[0], 0, False
    for shares in SHARES:
        for delay in DELAYS:
            most = min(int((best - delay) / h) - 1, MOST_STEPS)
            if most < 3 or delay >= delay_of >= 0.0:
                break
            count = _attempt(
                knots, states, when + delay, start, h, most, lower, upper, velocity, acceleration, jerk, shares,
                control, here, deviation,
            )  # fmt: skip
            is_laid = count > 0
            if is_laid:
                best, delay_of, shares_of, last = delay + (count + 1) * h, delay, shares, count
    if delay_of < 0.0:
        return 0
    if not is_laid:  # another one was tried after it
        last = _attempt(
            knots, states, when + delay_of, start, h, MOST_STEPS, lower, upper, velocity, acceleration, jerk,
            shares_of, control, here, deviation,
        )  # fmt: skip
    for i in range(dof):
        curved = acceleration[i]
        for k in range(piece, len(knots)):
            curved = max(curved, abs(states[2, k, i]))
        deviation[i] += h * h / 8.0 * (acceleration[i] + curved)
    copied = _copy(knots, states, when, when + delay_of, times, out) if delay_of > 0.0 else 0
    return copied + spline_knots(start, control, last, h, delay_of, times[copied:], out[:, copied:])


@entry_point
def stop_on_path(
    knots: Floats, states: Floats, when: float, start: Floats, lower: Floats, upper: Floats, velocity: Floats,
    acceleration: Floats, jerk: Floats, allowed: float, control: Floats, here: Floats, deviation: Floats,
    times: Floats, out: Floats,
) -> int:  # fmt: skip
    """Find the soonest stop along the path of a motion that ends at rest.

    Args:
        knots: Times of the motion, shape (K,) [s].
        states: Positions, velocities and accelerations at them, shape (3, K, dof).
        when: Time from which it stops [s].
        start: Buffer for a state, shape (3, dof).
        lower: Lowest positions, shape (dof,) [rad].
        upper: Highest positions, shape (dof,) [rad].
        velocity: Limits of velocity, shape (dof,) [rad/s].
        acceleration: Limits of acceleration, shape (dof,) [rad/s^2].
        jerk: Limits of jerk, shape (dof,) [rad/s^3].
        allowed: Largest distance of any joint from the path [rad].
        control: Buffer, shape (MOST_STEPS + 4, dof).
        here: Buffer, shape (dof,).
        deviation: Gets a bound on the distance of each joint from the path, shape (dof,) [rad].
        times: Gets the times of the knots, shape (K + MOST_STEPS + 4,) [s].
        out: Gets the states at them, shape (3, K + MOST_STEPS + 4, dof).

    Returns:
        The number of knots; 0 where no stop ends before the motion.
    """
    return int(
        soonest_stop(
            knots, states, when, start, lower, upper, velocity, acceleration, jerk, allowed, control, here, deviation,
            times, out,
        )
    )  # fmt: skip
