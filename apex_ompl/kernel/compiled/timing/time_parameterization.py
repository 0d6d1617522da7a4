"""Time-optimal parameterization of a curve by reachability analysis (Pham and Pham 2018), and polyline distances.

Along a curve q(s), with x = (ds/dt)^2 and u = d^2s/dt^2, the limits are

    |q'| sqrt(x) <= v   and   low <= q' u + q'' x <= high,

the second linear in x and u. Those of an acceleration are -a and a. A torque has the same form, with M q' and
M q'' + C q' in place of q' and q'', and limits less the torque of gravity. On a grid, x[i + 1] = x[i] + 2 step u[i]. A
backward pass finds at each point the largest x from which the next point's set can be reached, by Newton's method, and
a forward pass takes the largest u that stays inside these sets. From rest every set holds 0, so that the sets are
intervals [0, x].

How far a curve deviates from the path that it stands for is measured by the distances of its points from a polyline.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats

MOST_STEPS = 64  # of Newton's method; few are needed
STILL = 1e-10  # |q'| below which a joint does not move along the curve


@inlined
def _u_range(
    first: Floats, second: Floats, low: Floats, high: Floats, i: int, x: float, after: float, step: float
) -> tuple[float, float, float]:
    """Return the least and largest u at point ``i``, and the rate of the least minus the largest by x.

    With low <= q' u + q'' x <= high, and with an x at the next point that is at least 0 and at most ``after``.
    """
    by_next = -0.5 / step
    least, least_rate, most, most_rate = by_next * x, by_next, by_next * (x - after), by_next
    for j in range(first.shape[1]):
        slope = first[i, j]
        if abs(slope) < STILL:
            continue
        rate = -second[i, j] / slope
        below = rate * x + (low[i, j] if slope > 0.0 else high[i, j]) / slope
        above = rate * x + (high[i, j] if slope > 0.0 else low[i, j]) / slope
        if below > least:
            least, least_rate = below, rate
        if above < most:
            most, most_rate = above, rate
    return least, most, least_rate - most_rate


@entry_point
def max_path_speeds(
    first: Floats, second: Floats, velocity: Floats, low: Floats, high: Floats, step: float, x: Floats
) -> None:
    """Find the largest squared path speeds along a curve, from rest to rest.

    Args:
        first: Derivatives q' by arc length at evenly spaced points, shape (n, rows).
        second: Derivatives q'', shape (n, rows) [1/rad].
        velocity: Limits, shape (rows,) [rad/s]; infinite for none.
        low: Least q' u + q'' x, not positive, shape (n, rows).
        high: Largest, not negative, shape (n, rows).
        step: Spacing of the points along the curve [rad].
        x: Bounds on (ds/dt)^2, shape (n,) [rad^2/s^2]; gets the largest (ds/dt)^2.
    """
    n, rows = first.shape
    for i in range(n):
        most = x[i]
        for j in range(rows):
            slope, bend = abs(first[i, j]), second[i, j]
            if slope > STILL:
                most = min(most, (velocity[j] / slope) ** 2)
            elif bend > 0.0:
                most = min(most, high[i, j] / bend)
            elif bend < 0.0:
                most = min(most, low[i, j] / bend)
        x[i] = most
    x[n - 1] = 0.0
    for i in range(n - 2, -1, -1):
        at = x[i]
        for _ in range(MOST_STEPS):  # least minus largest u is convex in x and not positive at 0: from the right, exact
            least, most, rate = _u_range(first, second, low, high, i, at, x[i + 1], step)
            nearer = max(0.0, at - (least - most) / rate) if rate > 0.0 else 0.0
            if least <= most or not nearer < at:
                break
            at = nearer
        x[i] = at
    x[0] = 0.0
    for i in range(n - 1):
        least, most, _ = _u_range(first, second, low, high, i, x[i], x[i + 1], step)
        u = most if least <= most else 0.5 * (least + most)  # rounding may leave an empty interval
        x[i + 1] = max(0.0, min(x[i + 1], x[i] + 2 * step * u))


@entry_point
def sample_times(x: Floats, step: float, spacing: float, place: Floats) -> float:
    """Find the arc lengths at evenly spaced times of a motion along a curve; return its duration [s].

    Args:
        x: Squared path speeds at evenly spaced points, linear in between, shape (n,) [rad^2/s^2].
        step: Spacing of the points [rad].
        spacing: Time step [s]; 0 for the duration alone.
        place: Gets the arc lengths, the first one at time 0, shape (K,) [rad].
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
def _squared_distance(points: Floats, n: int, path: Floats, k: int) -> float:
    """Return the squared distance of point ``n`` from segment ``k`` of a polyline."""
    along, squared = 0.0, 0.0
    for j in range(points.shape[1]):
        side = path[k + 1, j] - path[k, j]
        along += (points[n, j] - path[k, j]) * side
        squared += side * side
    share = min(max(along / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    squared_distance = 0.0
    for j in range(points.shape[1]):
        difference = points[n, j] - path[k, j] - share * (path[k + 1, j] - path[k, j])
        squared_distance += difference * difference
    return squared_distance


@entry_point
def max_distance(points: Floats, places: Floats, path: Floats, arc: Floats, window: float) -> float:
    """Return the largest distance of points from a polyline, each from the part near its own arc length.

    Args:
        points: Shape (N, dof).
        places: Their arc lengths, ascending, shape (N,).
        path: States of the polyline, two or more, shape (M, dof).
        arc: Arc lengths of its states, shape (M,).
        window: Half length of that part.
    """
    middle, worst, last = 0, 0.0, arc.shape[0] - 2
    for n in range(points.shape[0]):
        while middle < last and arc[middle + 1] < places[n]:
            middle += 1
        least = _squared_distance(points, n, path, middle)
        before, after = middle - 1, middle + 1
        while least > worst:  # a smaller distance does not change the maximum
            more = after <= last and arc[after] <= places[n] + window
            less = before >= 0 and arc[before + 1] >= places[n] - window
            if not more and not less:
                break
            if more:
                least = min(least, _squared_distance(points, n, path, after))
                after += 1
            if less:
                least = min(least, _squared_distance(points, n, path, before))
                before -= 1
        worst = max(worst, least)
    return math.sqrt(worst)
