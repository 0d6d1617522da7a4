"""Curves through the joint space that are proved free: straight lines between states, or cubic pieces over time.

A curve has K knots with increasing parameters; those of a polyline are lengths, without derivatives. A cubic has the
velocities and accelerations at its knots, and constant jerk between them.
"""

from __future__ import annotations

from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.workspace import Workspace

ROUNDING = 1e-12


@inlined
def piece_of(knots: Floats | Integers, u: float) -> int:
    """Return the piece that a parameter lies on: the largest k with ``knots[k] <= u``, the last piece at the end."""
    low, high = 0, len(knots) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if knots[middle] <= u:
            low = middle
        else:
            high = middle
    return low


@inlined
def set_state(knots: Floats, states: Floats, rates: Floats, u: float, out: Floats) -> None:
    """Put the state at a parameter into ``out`` (dof,)."""
    k = piece_of(knots, u)
    long = knots[k + 1] - knots[k]
    if u >= knots[k + 1] or not long > 0.0:
        for i in range(len(out)):
            out[i] = states[k + 1, i]
        return
    since, dof = u - knots[k], len(out)
    for i in range(dof):
        if len(rates) == 0:
            out[i] = states[k, i] + since / long * (states[k + 1, i] - states[k, i])
        else:
            v, a, jerk = rates[k, i], rates[k, dof + i], (rates[k + 1, dof + i] - rates[k, dof + i]) / long
            out[i] = states[k, i] + since * (v + since * (a / 2.0 + since * jerk / 6.0))


@inlined
def _set_polyline(knots: Floats, states: Floats, a: float, b: float, middle: Floats, w: Workspace) -> None:
    """Set step and deviation for a polyline: the chord, and the largest distance of a vertex from it."""
    empty, half = states[:0], 0.5 * (b - a)
    dof, center = len(middle), a + half
    set_state(knots, states, empty, b, w.end)
    for i in range(dof):
        w.step[i] = w.end[i]
    set_state(knots, states, empty, a, w.end)
    for i in range(dof):
        w.step[i] = 0.5 * (w.step[i] - w.end[i])
        w.deviation[i] = abs(w.end[i] - (middle[i] - w.step[i]))
        w.half_width[i] = 0.0
    if not half > 0.0:
        return
    k = piece_of(knots, a) + 1
    while k < len(knots) and knots[k] < b:
        along = min(max((knots[k] - center) / half, -1.0), 1.0)
        for i in range(dof):
            w.deviation[i] = max(w.deviation[i], abs(states[k, i] - middle[i] - along * w.step[i]))
        k += 1


@inlined
def _set_cubic(knots: Floats, rates: Floats, a: float, b: float, middle: float, w: Workspace) -> None:
    """Set step and deviation for cubic pieces: h q'(m), and h^2 / 2 max |q''| by Taylor's theorem."""
    dof, half = len(w.step), 0.5 * (b - a)
    k, first, last = piece_of(knots, middle), piece_of(knots, a), piece_of(knots, b)
    since, long = middle - knots[k], knots[k + 1] - knots[k]
    for i in range(dof):
        acceleration = rates[k, dof + i]
        jerk = (rates[k + 1, dof + i] - acceleration) / long
        w.step[i] = half * (rates[k, i] + since * (acceleration + 0.5 * since * jerk))
        largest = 0.0
        for m in range(first, last + 1):  # the acceleration is linear on each piece: largest where the piece is cut
            jerk = (rates[m + 1, dof + i] - rates[m, dof + i]) / (knots[m + 1] - knots[m])
            low, high = max(a, knots[m]) - knots[m], min(b, knots[m + 1]) - knots[m]
            largest = max(largest, abs(rates[m, dof + i] + low * jerk), abs(rates[m, dof + i] + high * jerk))
        w.deviation[i] = 0.5 * half * half * largest


@inlined
def set_motion(
    knots: Floats, states: Floats, rates: Floats, slack: float, a: float, b: float, middle: Floats, w: Workspace
) -> None:
    """Set step, deviation and half width of ``w`` for the curve from parameter ``a`` to ``b`` around its middle.

    Args:
        knots: Parameters, shape (K,).
        states: States, shape (K, dof).
        rates: Velocities and accelerations side by side, shape (K, 2 dof), or (0, 2 dof) for a polyline.
        slack: Sum of the gaps between the pieces, by rounding.
        a: Start of the interval.
        b: Its end.
        middle: State in its middle, shape (dof,).
        w: Buffers of the state.
    """
    if len(rates) == 0:
        _set_polyline(knots, states, a, b, middle, w)
    else:
        _set_cubic(knots, rates, a, b, 0.5 * (a + b), w)
    for i in range(len(middle)):
        w.deviation[i] += slack + ROUNDING
        w.half_width[i] = abs(w.step[i]) + w.deviation[i]
