"""Sets of times as disjoint intervals in order, in the first rows of arrays of shape (N, 2) [s]."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers

NEAR = 3e-3  # after an interval that is kept; times so near it are left out [s]


@inlined
def add_span(spans: Floats, count: int, first: float, last: float) -> int:
    """Add an interval to disjoint ones in order, (N, 2), the first ``count`` rows; return their number.

    Those that meet become one; where there is no room for one more, so do the two that are nearest.
    """
    k = 0
    while k < count and spans[k, 1] < first:
        k += 1
    end = k
    while end < count and spans[end, 0] <= last:
        first, last = min(first, spans[end, 0]), max(last, spans[end, 1])
        end += 1
    if end > k:
        spans[k, 0], spans[k, 1] = first, last
        for n in range(end, count):
            spans[k + 1 + n - end, 0], spans[k + 1 + n - end, 1] = spans[n, 0], spans[n, 1]
        return count - (end - k) + 1
    if count == len(spans):
        return _merged(spans, count, k, first, last)
    for n in range(count, k, -1):
        spans[n, 0], spans[n, 1] = spans[n - 1, 0], spans[n - 1, 1]
    spans[k, 0], spans[k, 1] = first, last
    return count + 1


@inlined
def _merged(spans: Floats, count: int, k: int, first: float, last: float) -> int:
    """Extend the nearer neighbor of place ``k`` by an interval; return the number of intervals."""
    if k == count or (k > 0 and first - spans[k - 1, 1] < spans[k, 0] - last):
        spans[k - 1, 1] = last
    else:
        spans[k, 0] = first
    return count


@inlined
def holds_span(spans: Floats, count: int, first: float, last: float) -> bool:
    """Whether one of the first ``count`` intervals contains another one."""
    for k in range(count):
        if spans[k, 0] <= first and last <= spans[k, 1]:
            return True
    return False


@inlined
def _keep(times: Floats, count: int, first: float, last: float) -> int:
    """Add an interval of times, but for one that adds next to nothing; where there is no room, the shortest gives way.

    Without a wait there are as many single times as sequences of levels.
    """
    shortest = len(times) - 1  # the earliest one stays
    for k in range(count):
        if times[k, 0] <= first and last <= times[k, 1] + NEAR:
            return count
        if 0 < k and count == len(times) and times[k, 1] - times[k, 0] < times[shortest, 1] - times[shortest, 0]:
            shortest = k
    if count == len(times):
        if first >= times[0, 0] and last - first <= times[shortest, 1] - times[shortest, 0]:
            return count
        count -= 1
        for k in range(shortest, count):
            times[k, 0], times[k, 1] = times[k + 1, 0], times[k + 1, 1]
    return add_span(times, count, first, last)


@inlined
def add_free(
    first: float, last: float, spans: Floats, counts: Integers, stage: int, pieces: int, passing: Floats, out: Floats,
    count: int, work: Floats,
) -> int:  # fmt: skip
    """Add to ``out`` the free arrivals of a stage that starts between two times; return how many there are."""
    work[0, 0], work[0, 1] = first, last
    parts = 1
    for f in range(pieces):
        p = stage * pieces + f
        for n in range(counts[p]):
            low, high = spans[p, n, 0] - passing[f + 1], spans[p, n, 1] - passing[f]
            k = 0
            while k < parts:
                if work[k, 1] <= low or work[k, 0] >= high:
                    k += 1
                elif work[k, 0] <= low and work[k, 1] >= high and parts < len(work):
                    for r in range(parts, k + 1, -1):
                        work[r, 0], work[r, 1] = work[r - 1, 0], work[r - 1, 1]
                    work[k + 1, 0], work[k + 1, 1] = high, work[k, 1]
                    work[k, 1] = low
                    parts, k = parts + 1, k + 2
                elif work[k, 0] <= low:
                    work[k, 1] = low
                    k += 1
                elif work[k, 1] >= high:
                    work[k, 0] = high
                    k += 1
                else:
                    for r in range(k, parts - 1):
                        work[r, 0], work[r, 1] = work[r + 1, 0], work[r + 1, 1]
                    parts -= 1
    for k in range(parts):
        count = _keep(out, count, work[k, 0] + passing[pieces], work[k, 1] + passing[pieces])
    return count


@inlined
def free_until(spans: Floats, count: int, time: float) -> float:
    """Return the end of the free interval that a time is in: infinity, or the time itself where it is blocked."""
    for n in range(count):
        if spans[n, 1] > time:
            return float(max(spans[n, 0], time))
    return math.inf
