"""Motions of constant jerk in phases, joint by joint, one state-to-state problem after the other, at common knots."""

from __future__ import annotations

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers

SPLITS = 4  # parts of each profile, so that three jerks at least can be corrected
TICK = 1e-9  # of the times at which the jerk changes [s]
REGULARIZATION = 1e-14


@inlined
def _sort(values: Integers, count: int) -> None:
    """Sort the first ``count`` values by insertion."""
    for i in range(1, count):
        value, at = values[i], i
        while at > 0 and values[at - 1] > value:
            values[at] = values[at - 1]
            at -= 1
        values[at] = value


@inlined
def _lay_pieces(
    phases: Floats, jerks: Floats, first: int, last: int, k: int, j: int, edges: Integers, pieces: Floats
) -> None:
    """Write the starts of the pieces of a profile [ticks], phases and splits alike, and their jerks."""
    count, size = phases.shape[2], phases.shape[2] + SPLITS - 1
    end = first * TICK
    for p in range(count):
        edges[k, j, p] = min(max(round(end / TICK), first), last)
        end += phases[k, j, p]
    edges[k, j, 0] = first
    for s in range(1, SPLITS):
        edges[k, j, count + s - 1] = first + (last - first) * s // SPLITS
    _sort(edges[k, j], size)
    phase, end = 0, first * TICK + phases[k, j, 0]
    for p in range(size):
        following = edges[k, j, p + 1] if p + 1 < size else last
        middle = 0.5 * (edges[k, j, p] + following) * TICK
        while phase + 1 < count and end <= middle:
            phase += 1
            end += phases[k, j, phase]
        pieces[3, k, j, p] = jerks[k, j, phase]


@inlined
def _correct(states: Floats, last: int, k: int, j: int, edges: Integers, pieces: Floats) -> None:
    """Change the jerks of a profile by the least that lets it end at its target.

    The state at the end is linear in the jerks. With the duration as the unit of time, what a piece of length h, at
    whose end r is left, adds per unit of jerk is h (r^2 / 2 + r h / 2 + h^2 / 6) to the position, h (r + h / 2) to the
    velocity, and h to the acceleration.
    """
    size, first = edges.shape[2], edges[k, j, 0]
    t = (last - first) * TICK
    if t <= 0.0:
        return
    q, v, a = states[0, k, j], states[1, k, j], states[2, k, j]
    x = (states[0, k + 1, j] - q - t * (v + t * a / 2.0)) / t**3
    y = (states[1, k + 1, j] - v - t * a) / t**2
    z = (states[2, k + 1, j] - a) / t
    xx = yy = zz = REGULARIZATION
    xy = xz = yz = 0.0
    for p in range(size):
        following = edges[k, j, p + 1] if p + 1 < size else last
        h, r = (following - edges[k, j, p]) * TICK / t, (last - following) * TICK / t
        gx, gy, gz = h * (r * r / 2.0 + r * h / 2.0 + h * h / 6.0), h * (r + h / 2.0), h
        jerk = pieces[3, k, j, p]
        x, y, z = x - gx * jerk, y - gy * jerk, z - gz * jerk
        xx, yy, zz, xy, xz, yz = xx + gx * gx, yy + gy * gy, zz + gz * gz, xy + gx * gy, xz + gx * gz, yz + gy * gz
    low, lower = xy / xx, xz / xx  # elimination in a symmetric matrix
    yy, yz, zz = yy - low * xy, yz - low * xz, zz - lower * xz
    y, z = y - low * x, z - lower * x
    lowest = yz / yy
    z = (z - lowest * y) / (zz - lowest * yz)
    y = (y - yz * z) / yy
    x = (x - xy * y - xz * z) / xx
    for p in range(size):
        following = edges[k, j, p + 1] if p + 1 < size else last
        h, r = (following - edges[k, j, p]) * TICK / t, (last - following) * TICK / t
        gx, gy, gz = h * (r * r / 2.0 + r * h / 2.0 + h * h / 6.0), h * (r + h / 2.0), h
        pieces[3, k, j, p] += gx * x + gy * y + gz * z


@inlined
def _integrate(states: Floats, last: int, k: int, j: int, edges: Integers, pieces: Floats) -> None:
    """Write the position, velocity and acceleration at the start of each piece of a profile."""
    size = edges.shape[2]
    q, v, a = states[0, k, j], states[1, k, j], states[2, k, j]
    for p in range(size):
        pieces[0, k, j, p], pieces[1, k, j, p], pieces[2, k, j, p] = q, v, a
        following = edges[k, j, p + 1] if p + 1 < size else last
        t, jerk = (following - edges[k, j, p]) * TICK, pieces[3, k, j, p]
        q += t * (v + t * (a / 2.0 + t * jerk / 6.0))
        v += t * (a + t * jerk / 2.0)
        a += t * jerk


@entry_point
def join_profiles(
    phases: Floats, jerks: Floats, starts: Integers, states: Floats,
    edges: Integers, pieces: Floats, merged: Integers, times: Floats, knots: Floats,
) -> int:  # fmt: skip
    """Join the profiles of state-to-state problems to a motion, whose knots are where the jerk of any joint changes.

    The jerks are corrected so that every profile ends at its target exactly: solvers end their search some 1e-8 from
    it, and times are rounded to ticks of 1 ns.

    Args:
        phases: Durations of the phases of each problem and joint, shape (K, dof, P) [s].
        jerks: Jerks in them, shape (K, dof, P) [rad/s^3].
        starts: Times at which the problems start and the last one ends, shape (K + 1,) [ticks].
        states: Positions, velocities and accelerations between which they go, shape (3, K + 1, dof).
        edges: Buffer for the starts of pieces, shape (K, dof, P + SPLITS - 1).
        pieces: Buffer for their states and jerks, shape (4, K, dof, P + SPLITS - 1).
        merged: Buffer for the starts of a problem's pieces, shape (dof (P + SPLITS - 1),).
        times: Gets the times of the knots, shape (K dof (P + SPLITS - 1) + 1,) [s].
        knots: Gets positions, velocities and accelerations at them, shape (3, that, dof).

    Returns:
        The number of knots.
    """
    problems, dof, size = edges.shape
    count = 0
    for k in range(problems):
        first, last = starts[k], starts[k + 1]
        for j in range(dof):
            _lay_pieces(phases, jerks, first, last, k, j, edges, pieces)
            _correct(states, last, k, j, edges, pieces)
            _integrate(states, last, k, j, edges, pieces)
            for p in range(size):
                merged[j * size + p] = edges[k, j, p]
        _sort(merged, dof * size)
        distinct = 0
        for i in range(dof * size):
            if merged[i] < last and (i == 0 or merged[i] > merged[i - 1]):
                merged[distinct] = merged[i]
                distinct += 1
        for j in range(dof):
            p = 0
            for i in range(distinct):
                while p + 1 < size and edges[k, j, p + 1] <= merged[i]:
                    p += 1
                t = (merged[i] - edges[k, j, p]) * TICK
                v, a, jerk = pieces[1, k, j, p], pieces[2, k, j, p], pieces[3, k, j, p]
                knots[0, count + i, j] = pieces[0, k, j, p] + t * (v + t * (a / 2.0 + t * jerk / 6.0))
                knots[1, count + i, j] = v + t * (a + t * jerk / 2.0)
                knots[2, count + i, j] = a + t * jerk
        for i in range(distinct):
            times[count + i] = merged[i] * TICK
        count += distinct
    times[count] = starts[problems] * TICK
    for order in range(3):
        for j in range(dof):
            knots[order, count, j] = states[order, problems, j]
    return count + 1
