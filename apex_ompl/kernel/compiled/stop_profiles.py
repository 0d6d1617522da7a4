"""Soonest stops of joints from any state of motion, each by itself, in closed form.

From velocity v and acceleration a, within |a| <= A and |jerk| <= J, the soonest stop has three phases of jerk -J, 0 and
J (mirrored where v + a |a| / (2 J), the velocity left when a has been brought to 0, is negative). With
p = min(sqrt(J v + a^2 / 2), A) the acceleration goes from a to -p, stays there, and returns to 0:

    t1 = (a + p) / J,   t2 = (v + a^2 / (2 J)) / p - p / J,   t3 = p / J.

This is the problem of Ruckig's velocity interface (Berscheid and Kroeger 2021), which tests compare it with. That stop
gives up braking early so as to rest with both v and a at 0; where it would pass a position limit, braking goes on for
as short a time as keeps the limit, until v = 0 at the latest, and the joint swings back.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats

PHASES = 5  # of a stop: two of braking on, and three of the soonest stop from there
SAME_TIME = 1e-10  # times between which there is one knot [s]
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
def _set_soonest(v: float, a: float, most: float, jerk: float, begin: int, lengths: Floats, jerks: Floats) -> None:
    """Set the three phases of the soonest stop, from the phase ``begin`` on."""
    sign = 1.0 if v + a * abs(a) / (2.0 * jerk) >= 0.0 else -1.0
    v, a = sign * v, sign * a
    peak = math.sqrt(max(jerk * v + 0.5 * a * a, 0.0))
    plateau, most = 0.0, max(most, -a)
    if peak > most:
        plateau = (v + 0.5 * a * a / jerk) / most - most / jerk
        peak = most
    lengths[begin], jerks[begin] = max(a + peak, 0.0) / jerk, -sign * jerk
    lengths[begin + 1], jerks[begin + 1] = max(plateau, 0.0), 0.0
    lengths[begin + 2], jerks[begin + 2] = peak / jerk, sign * jerk


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
            if end - times[at - 1] <= SAME_TIME or (at < count and times[at] - end <= SAME_TIME):
                continue
            if last - end <= SAME_TIME:
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
        k, begin = 0, 0.0
        x, y, z = q[i], v[i], a[i]
        for p in range(PHASES):
            while k < count and times[k] < begin + lengths[i, p]:
                since = max(times[k] - begin, 0.0)
                knots[0, k, i], knots[1, k, i], knots[2, k, i] = moved(x, y, z, jerks[i, p], since)
                k += 1
            x, y, z = moved(x, y, z, jerks[i, p], lengths[i, p])
            begin += lengths[i, p]
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
        v: Velocities, likewise [rad/s].
        a: Accelerations, likewise [rad/s^2].
        lower: Lowest positions, likewise.
        upper: Highest positions, likewise.
        acceleration: Limits, likewise.
        jerk: Limits, likewise.
        lengths: Room for the lengths of the phases, shape (dof, PHASES) [s].
        jerks: Room for the jerks in them, likewise [rad/s^3].
        times: Gets the times at which the jerk of any joint changes, shape (dof PHASES + 1,) [s].
        knots: Gets positions, velocities and accelerations at them, shape (3, that, dof).
        beyond: Gets how far each joint passes a position limit, shape (dof,) [rad].

    Returns:
        The number of knots.
    """
    return int(soonest_stops(q, v, a, lower, upper, acceleration, jerk, lengths, jerks, times, knots, beyond))
