"""Earliest arrival along a path among blocked intervals of time, with bounded speeds and accelerations.

The path is a motion q(s) over its own time s; x = (ds/dt)^2. Stages of equal length in s lie between S + 1 points, and
x at a point is one of the levels x_m, with x_0 = 0. Along a stage x is linear in s, so that the acceleration along the
path is constant, d^2s/dt^2 = (x' - x) / (2 length). The joints' limits must hold at the ends of the stage's pieces,

    |q' ds/dt| <= v_max,   |q' d^2s/dt^2 + q'' x| <= a_max,

and the piece that is passed from t to t' must be free from t to t'. As in planning with safe intervals (Phillips and
Likhachev 2011), what is kept of a point and a level is not a time but the intervals of all times at which it can be
reached, for with a speed one cannot wait (as Johnson and Hauser 2012 propagate reachable speeds). At level 0 the
robot may wait while the point is free, which adds the times up to the next blocked interval. The earliest time at the
end is then followed back.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.moving.time_sets import add_free, add_span, free_until

MOST_TIMES = 12  # intervals of times that are kept of a point and a level
SAME = 1e-9  # [s]


@inlined
def x_along(x: Floats, i: int, j: int, part: float) -> float:
    """Return x at a part of a stage between levels; from 0 to 0 it goes by way of level 1."""
    if i == 0 and j == 0:
        return float(x[1] * (1.0 - abs(2.0 * part - 1.0)))
    return float(x[i] + (x[j] - x[i]) * part)


@inlined
def passing_time(x: Floats, i: int, j: int, part: float, length: float) -> float:
    """Return the time that the first ``part`` of a stage takes between levels."""
    if part <= 0.0:
        return 0.0
    if i == 0 and j == 0 and part > 0.5:
        whole, left = 2.0 * length / math.sqrt(x[1]), 1.0 - part
        return float(whole - (2.0 * length * left / math.sqrt(2.0 * left * x[1]) if left > 0.0 else 0.0))
    return float(2.0 * length * part / (math.sqrt(x[i]) + math.sqrt(x_along(x, i, j, part))))


@inlined
def _allowed(
    x: Floats, lowest: Floats, highest: Floats, i: int, j: int, length: float, first: int, pieces: int
) -> bool:
    """Whether a stage, ``pieces`` long from ``first`` on, may be passed between levels; bounds of ``push_bounds``.

    The bounds between levels are bounded by their chords, as those are convex and concave in x.
    """
    for f in range(pieces + 1):
        part = f / pieces
        here, push = x_along(x, i, j, part), (x[j] - x[i]) / (2.0 * length)
        if i == 0 and j == 0:
            push = math.copysign(x[1] / length, 0.5 - part)
        m = 0
        while m + 2 < len(x) and x[m + 1] < here:
            m += 1
        rest, p = (here - x[m]) / (x[m + 1] - x[m]), first + f
        low, high = lowest[p, m], highest[p, m]
        if rest > 0.0:
            if lowest[p, m + 1] > highest[p, m + 1]:
                return False
            low, high = low + rest * (lowest[p, m + 1] - low), high + rest * (highest[p, m + 1] - high)
        if not low <= push <= high:
            return False
    return True


@inlined
def _wait(spans: Floats, count: int, arrivals: Floats, number: int, latest: float, out: Floats) -> int:
    """Put arrivals, extended by waiting while a point is free, into ``out``; return their number."""
    found = 0
    for k in range(number):
        last = min(max(free_until(spans, count, arrivals[k, 0]), arrivals[k, 1]), latest)
        found = add_span(out, found, arrivals[k, 0], last)
    return found


@inlined
def _set_start(
    spans: Floats, count: int, own: int, rests: bool, start: float, latest: float, times: Floats, numbers: Integers,
    arrivals: Floats, arrived: Integers,
) -> None:  # fmt: skip
    """Set the times of the first point, and no others."""
    for k in range(len(arrived)):
        arrived[k] = 0
        for m in range(numbers.shape[1]):
            numbers[k, m] = 0
    last = start
    if rests:
        last = min(free_until(spans, count, start), latest)
        arrivals[0, 0] = arrivals[0, 1] = start
        arrived[0] = 1
    for m in range(numbers.shape[1]):
        if rests or m == own:  # at rest q' is 0: it may go at any level
            times[m, 0, 0], times[m, 0, 1] = start, last
            numbers[0, m] = 1


@entry_point
def earliest_arrivals(
    spans: Floats, counts: Integers, point_spans: Floats, point_counts: Integers, lowest: Floats, highest: Floats,
    x: Floats, length: float, own: int, rests: bool, forced: int, start: float, latest: float, hold: float,
    times: Floats, numbers: Integers, arrivals: Floats, arrived: Integers, work: Floats, passing: Floats,
    levels: Integers, departures: Floats,
) -> bool:  # fmt: skip
    """Find the profile that arrives at the end of a path first.

    Args:
        spans: Blocked intervals of the pieces, shape (P, MOST_SPANS, 2); P = S pieces a stage.
        counts: Their numbers, shape (P,).
        point_spans: Blocked intervals of the points between stages, shape (S + 1, MOST_SPANS, 2).
        point_counts: Their numbers, shape (S + 1,).
        lowest: Bounds at the P + 1 ends of pieces, see :func:`push_bounds`.
        highest: The same.
        x: Levels, increasing from 0.
        length: Of a stage in s [s].
        own: Level of the motion's own rate, x = 1: that at the start.
        rests: Whether it starts at rest: then it may wait there, and go at any level, as q' is 0.
        forced: Number of stages at the start that keep the motion's own rate.
        start: Time at the start [s].
        latest: The last time at the end [s].
        hold: Time for which the end must stay free from the arrival on [s].
        times: Buffer, shape (S + 1, levels, MOST_TIMES, 2).
        numbers: Buffer, shape (S + 1, levels).
        arrivals: Buffer, shape (S + 1, MOST_TIMES, 2).
        arrived: Buffer, shape (S + 1,).
        work: Buffer, shape (4 MOST_TIMES, 2).
        passing: Buffer, shape (pieces a stage + 1,).
        levels: Gets the levels of the profile, shape (S + 1,).
        departures: Gets the times at which it arrives at and leaves the points, shape (S + 1, 2) [s].

    Returns:
        Whether there is one.
    """
    stages, most = len(point_counts) - 1, lowest.shape[1]
    pieces = len(counts) // stages
    _set_start(point_spans[0], point_counts[0], own, rests, start, latest, times[0], numbers, arrivals[0], arrived)
    for k in range(stages):
        for i in range(most):
            for j in range(most):
                if (k < forced and not i == j == own) or numbers[k, i] == 0:
                    continue
                if not _allowed(x, lowest, highest, i, j, length, k * pieces, pieces):
                    continue
                for f in range(pieces + 1):
                    passing[f] = passing_time(x, i, j, f / pieces, length)
                out, count = (arrivals[k + 1], arrived[k + 1]) if j == 0 else (times[k + 1, j], numbers[k + 1, j])
                for n in range(numbers[k, i]):
                    first, last = times[k, i, n, 0], min(times[k, i, n, 1], latest - passing[pieces])
                    if first <= last:
                        count = add_free(first, last, spans, counts, k, pieces, passing, out, count, work)
                if j == 0:
                    arrived[k + 1] = count
                else:
                    numbers[k + 1, j] = count
        numbers[k + 1, 0] = _wait(
            point_spans[k + 1], point_counts[k + 1], arrivals[k + 1], arrived[k + 1], latest, times[k + 1, 0]
        )
    return _follow_back(
        spans, counts, point_spans, point_counts, lowest, highest, x, length, forced, own, rests, hold, times, numbers,
        arrivals, arrived, passing, levels, departures,
    )  # fmt: skip


@inlined
def _best_end(spans: Floats, count: int, times: Floats, numbers: Integers, hold: float) -> tuple[int, float]:
    """Return the level and time of the earliest arrival after which the end is free for long enough; -1 for none."""
    level, best = -1, math.inf
    for m in range(len(numbers)):
        for n in range(numbers[m]):
            time = times[m, n, 0]
            for r in range(count):
                if time + hold > spans[r, 0] and time < spans[r, 1]:
                    time = spans[r, 1] + SAME
            if time <= times[m, n, 1] + SAME and time < best:
                level, best = m, time
    return level, best


@inlined
def _contains(times: Floats, number: int, time: float) -> bool:
    """Whether a time is in one of some intervals, rounded."""
    for n in range(number):
        if times[n, 0] - SAME <= time <= times[n, 1] + SAME:
            return True
    return False


@inlined
def _passes(first: float, spans: Floats, counts: Integers, stage: int, pieces: int, passing: Floats) -> bool:
    """Whether a stage may start at a time, rounded."""
    for f in range(pieces):
        p = stage * pieces + f
        for n in range(counts[p]):
            if first + passing[f + 1] > spans[p, n, 0] + SAME and first + passing[f] < spans[p, n, 1] - SAME:
                return False
    return True


@inlined
def _last_arrival(arrivals: Floats, number: int, time: float) -> float:
    """Return the last arrival from which it can have waited until a time."""
    latest = -math.inf
    for n in range(number):
        if arrivals[n, 0] <= time + SAME:
            latest = max(latest, min(arrivals[n, 1], time))
    return latest


@inlined
def _follow_back(
    spans: Floats, counts: Integers, point_spans: Floats, point_counts: Integers, lowest: Floats, highest: Floats,
    x: Floats, length: float, forced: int, own: int, rests: bool, hold: float, times: Floats, numbers: Integers,
    arrivals: Floats, arrived: Integers, passing: Floats, levels: Integers, departures: Floats,
) -> bool:  # fmt: skip
    """Set levels and times of the earliest arrival; each level the nearest to the one after it."""
    stages = len(point_counts) - 1
    pieces = len(counts) // stages
    level, time = _best_end(point_spans[stages], point_counts[stages], times[stages], numbers[stages], hold)
    if level < 0:
        return False
    levels[stages] = level
    departures[stages, 0] = departures[stages, 1] = time
    for k in range(stages, -1, -1):
        if levels[k] == 0 and k > 0 or k == 0 and rests:
            time = departures[k, 0] = _last_arrival(arrivals[k], arrived[k], time)
        if k == 0:
            return True
        chosen, started = -1, 0.0
        for i in range(numbers.shape[1]):
            if chosen >= 0 and abs(i - levels[k]) >= abs(chosen - levels[k]):
                continue
            if (k <= forced and not i == levels[k] == own) or not _allowed(
                x, lowest, highest, i, levels[k], length, (k - 1) * pieces, pieces
            ):
                continue
            for f in range(pieces + 1):
                passing[f] = passing_time(x, i, levels[k], f / pieces, length)
            first = time - passing[pieces]
            if _contains(times[k - 1, i], numbers[k - 1, i], first) and _passes(
                first, spans, counts, k - 1, pieces, passing
            ):
                chosen, started = i, first
        if chosen < 0:
            return False
        time = started
        levels[k - 1] = chosen
        departures[k - 1, 0] = departures[k - 1, 1] = time
    return True
