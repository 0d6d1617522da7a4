"""Compiled: the fastest way along a curve, and how far points are from a polyline.

Along a curve with the derivatives q'(s) and q''(s), with x = (ds/dt)^2 and u = d^2s/dt^2, velocity is bounded by
|q'| sqrt(x) <= v and acceleration by |q' u + q'' x| <= a, which is linear in x and u. A pass from the end finds at each
point of a grid the largest x from which the end can still be reached, a pass from the start goes as fast as that lets
it (reachability analysis, Pham and Pham 2018). At rest everything is reachable, so that the sets are intervals from 0.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled import entry, inlined
from apex_ompl.kernel.tables import Floats

HALVINGS = 40
STILL = 1e-10  # below it a joint does not move along the curve


@inlined
def _reach(
    first: Floats, second: Floats, limit: Floats, i: int, x: float, low: float, high: float
) -> tuple[float, float]:
    """Return the least and largest u of an interval that the limits of acceleration allow, in wrong order for none."""
    for j in range(limit.shape[0]):
        slope, rest = first[i, j], second[i, j] * x
        if abs(slope) < STILL:
            if abs(rest) > limit[j]:
                return 1.0, -1.0
            continue
        one, other = (-limit[j] - rest) / slope, (limit[j] - rest) / slope
        low = max(low, min(one, other))
        high = min(high, max(one, other))
    return low, high


@entry
def fastest(first: Floats, second: Floats, velocity: Floats, acceleration: Floats, step: float, x: Floats) -> None:
    """Find the greatest squared speeds along a curve, from rest to rest.

    Args:
        first: First derivatives by arc length at even distances, shape (n, dof).
        second: Second derivatives, shape (n, dof).
        velocity: Limits, shape (dof,).
        acceleration: Limits, shape (dof,).
        step: Distance of the points along the curve.
        x: Gets (ds/dt)^2, shape (n,).
    """
    n, dof = first.shape
    for i in range(n):
        most = 1e12
        for j in range(dof):
            slope = abs(first[i, j])
            if slope > STILL:
                most = min(most, (velocity[j] / slope) ** 2)
        x[i] = most
    x[n - 1] = 0.0
    for i in range(n - 2, -1, -1):
        low, high = 0.0, x[i]
        for k in range(HALVINGS):
            at = high if k == 0 else 0.5 * (low + high)
            least, most = _reach(first, second, acceleration, i, at, -at / (2 * step), (x[i + 1] - at) / (2 * step))
            if least <= most:
                low = at
                if k == 0:
                    break
            else:
                high = at
        x[i] = low
    x[0] = 0.0
    for i in range(n - 1):
        at = x[i]
        least, most = _reach(first, second, acceleration, i, at, -at / (2 * step), (x[i + 1] - at) / (2 * step))
        if least <= most:  # by rounding it may not be
            x[i + 1] = max(0.0, min(x[i + 1], at + 2 * step * most))


@entry
def moments(x: Floats, step: float, spacing: float, place: Floats) -> float:
    """Find where along a curve a motion is at even times, and return how long it takes.

    Args:
        x: Squared speeds at even distances, linear in between, shape (n,).
        step: Their distance.
        spacing: Time between two moments; 0 for the duration alone.
        place: Gets the arc length at the moments, the first one at time 0, shape (K,).
    """
    duration, k = 0.0, 0
    for i in range(x.shape[0] - 1):
        speed = math.sqrt(x[i])
        took = 2.0 * step / max(speed + math.sqrt(x[i + 1]), 1e-9)
        push = (x[i + 1] - x[i]) / (2.0 * step)
        while k < place.shape[0] and spacing > 0.0 and k * spacing < duration + took:
            since = k * spacing - duration
            place[k] = i * step + min(speed * since + 0.5 * push * since * since, step)
            k += 1
        duration += took
    if spacing > 0.0:
        for rest in range(k, place.shape[0]):
            place[rest] = (x.shape[0] - 1) * step
    return duration


@inlined
def _apart(points: Floats, n: int, path: Floats, k: int) -> float:
    """Return the squared distance of a point from a side of a polyline."""
    along, squared = 0.0, 0.0
    for j in range(points.shape[1]):
        side = path[k + 1, j] - path[k, j]
        along += (points[n, j] - path[k, j]) * side
        squared += side * side
    share = min(max(along / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    apart = 0.0
    for j in range(points.shape[1]):
        gap = points[n, j] - path[k, j] - share * (path[k + 1, j] - path[k, j])
        apart += gap * gap
    return apart


@entry
def farthest(points: Floats, places: Floats, path: Floats, arc: Floats, window: float) -> float:
    """Return the largest distance of points from a polyline, each from the stretch about its own arc length.

    Args:
        points: Shape (N, dof).
        places: Their arc lengths, in rising order, shape (N,).
        path: States of the polyline, two or more, shape (M, dof).
        arc: Arc lengths of its states, shape (M,).
        window: How far the stretch goes to both sides.
    """
    middle, worst, last = 0, 0.0, arc.shape[0] - 2
    for n in range(points.shape[0]):
        while middle < last and arc[middle + 1] < places[n]:
            middle += 1
        least = _apart(points, n, path, middle)
        before, after = middle - 1, middle + 1
        while least > worst:  # or the point changes nothing
            more = after <= last and arc[after] <= places[n] + window
            less = before >= 0 and arc[before + 1] >= places[n] - window
            if not more and not less:
                break
            if more:
                least = min(least, _apart(points, n, path, after))
                after += 1
            if less:
                least = min(least, _apart(points, n, path, before))
                before -= 1
        worst = max(worst, least)
    return math.sqrt(worst)
