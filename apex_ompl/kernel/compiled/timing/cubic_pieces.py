"""Motions of constant jerk between knots: their values, extremes, and gaps.

Knots are times of shape (K,) [s]; positions, velocities and accelerations at them have shape (K, dof).
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.check.curve import piece_of
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats

ULPS = 4.0  # units in the last place by which times and accelerations of knots may be rounded, each several times
UNIT = 2.0**-52  # in the last place, as a share of a number that is a power of two


@inlined
def _rounding(x: float) -> float:
    """Return the unit in the last place of a number."""
    mantissa, exponent = math.frexp(abs(x))
    return math.ldexp(UNIT, max(exponent - 1, -1022)) if mantissa > 0.0 else math.ldexp(1.0, -1074)


@inlined
def _inside(time: float, length: float) -> float:
    """Return a time within a piece, 0 to ``length``; an end where it is none."""
    if not time < length:  # nor is what is no number
        return length
    return max(time, 0.0)


@entry_point
def sample_motion(
    knots: Floats, positions: Floats, velocities: Floats, accelerations: Floats, times: Floats, order: int, out: Floats
) -> None:
    """Sample a motion and its derivatives; before 0 and after the end the robot stands still.

    Args:
        knots: Times of the knots.
        positions: At them.
        velocities: At them.
        accelerations: At them.
        times: Shape (N,) [s].
        order: Of the first derivative that is wanted, 0 to 3.
        out: Gets it and those after it, shape (derivatives, N, dof).
    """
    last, end = len(knots) - 1, knots[len(knots) - 1]
    for n in range(len(times)):
        t = times[n]
        k = piece_of(knots, t) if last > 0 else 0
        following = min(k + 1, last)
        since, length = min(max(t, 0.0), end) - knots[k], knots[following] - knots[k]
        outside = t < 0.0 or t > end or last == 0
        for i in range(out.shape[2]):
            q, v, a = positions[k, i], velocities[k, i], accelerations[k, i]
            jerk = (accelerations[following, i] - a) / length if last > 0 else 0.0
            for m in range(len(out)):
                which = order + m
                if which == 0:
                    value = q + since * (v + since * (a / 2.0 + since * jerk / 6.0))
                    if t >= end:  # without rounding at the end
                        value = positions[last, i]
                elif outside:
                    value = 0.0
                elif which == 1:
                    value = velocities[last, i] if t >= end else v + since * (a + since * jerk / 2.0)
                elif which == 2:
                    value = accelerations[last, i] if t >= end else a + since * jerk
                else:
                    value = jerk
                out[m, n, i] = value


@inlined
def _piece_extremes(q: float, v: float, a: float, w: float, b: float, length: float, i: int, out: Floats) -> None:
    """Take a piece of a joint into the extremes of positions and velocities; at its end these are w and b."""
    least, largest = min(v, w), max(v, w)
    if (a < 0.0) != (b < 0.0):
        turn = _inside(a / (a - b) * length, length)
        inner = v + turn * a / 2.0
        least, largest = min(least, inner), max(largest, inner)
    out[2, i] = max(out[2, i], largest, -least)
    if least < 0.0 and largest > 0.0:
        jerk = (b - a) / length
        side = math.sqrt(a * a - 2.0 * jerk * v)
        for root in ((-a + side) / jerk, (-a - side) / jerk, -v / a):
            since = _inside(root, length)
            there = q + since * (v + since * (a / 2.0 + since * jerk / 6.0))
            out[0, i], out[1, i] = min(out[0, i], there), max(out[1, i], there)


@entry_point
def motion_extremes(knots: Floats, positions: Floats, velocities: Floats, accelerations: Floats, out: Floats) -> None:
    """Find the extremes of a motion, which are those between knots, too.

    Velocities are largest at knots or where the acceleration is 0, positions where a joint turns round. Jerks are the
    least that the knots allow for: between knots 1e-10 s apart, as several joints' own make them, the
    rounding of times and accelerations alone is worth 1e-6 of a jerk and more.

    Args:
        knots: Times of the knots.
        positions: At them.
        velocities: At them.
        accelerations: At them.
        out: Gets the least and largest positions, the largest velocities, accelerations and jerks, shape (5, dof).
    """
    for i in range(out.shape[1]):
        out[0, i] = out[1, i] = positions[0, i]
        out[2, i], out[3, i], out[4, i] = abs(velocities[0, i]), abs(accelerations[0, i]), 0.0
        for k in range(len(knots) - 1):
            q, v, w = positions[k + 1, i], velocities[k, i], velocities[k + 1, i]
            a, b, length = accelerations[k, i], accelerations[k + 1, i], knots[k + 1] - knots[k]
            out[0, i], out[1, i] = min(out[0, i], q), max(out[1, i], q)
            out[3, i] = max(out[3, i], abs(b))
            if abs(b - a) > out[4, i] * length:
                change = abs(b - a) - ULPS * _rounding(max(abs(a), abs(b)))
                out[4, i] = max(out[4, i], change / (length + ULPS * _rounding(knots[k + 1])))
            _piece_extremes(positions[k, i], v, a, w, b, length, i, out)


@entry_point
def relative_gap(knots: Floats, positions: Floats, velocities: Floats, accelerations: Floats) -> float:
    """Return the largest error of positions and velocities integrated from the knot before, relative to at least 1."""
    found = 0.0
    for k in range(len(knots) - 1):
        t = knots[k + 1] - knots[k]
        for i in range(positions.shape[1]):
            q, v, a, b = positions[k, i], velocities[k, i], accelerations[k, i], accelerations[k + 1, i]
            x, y = positions[k + 1, i], velocities[k + 1, i]
            found = max(found, abs(q + t * (v + t * (2.0 * a + b) / 6.0) - x) / max(1.0, abs(x)))
            found = max(found, abs(v + t * (a + b) / 2.0 - y) / max(1.0, abs(y)))
    return found


@entry_point
def cubic_rates(knots: Floats, positions: Floats, velocities: Floats, accelerations: Floats, rates: Floats) -> float:
    """Return the sum of the gaps between the pieces of a motion, for proofs along them [rad].

    Args:
        knots: Times of the knots, two or more.
        positions: At them.
        velocities: At them.
        accelerations: At them.
        rates: Gets velocities and accelerations side by side, shape (K, 2 dof).
    """
    count, dof = len(knots), positions.shape[1]
    places = speeds = 0.0
    for k in range(count):
        missed = missed_speed = 0.0
        for i in range(dof):
            v, a = velocities[k, i], accelerations[k, i]
            rates[k, i], rates[k, dof + i] = v, a
            if k + 1 < count:
                t, q, b = knots[k + 1] - knots[k], positions[k, i], accelerations[k + 1, i]
                missed = max(missed, abs(q + t * (v + t * (2.0 * a + b) / 6.0) - positions[k + 1, i]))
                missed_speed = max(missed_speed, abs(v + t * (a + b) / 2.0 - velocities[k + 1, i]))
        places, speeds = places + missed, speeds + missed_speed
    return float(places + speeds * knots[count - 1])
