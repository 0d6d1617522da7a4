"""Time-optimal parameterization of a curve by reachability analysis (Pham and Pham 2018).

Along a curve q(s), with x = (ds/dt)^2 and u = d^2s/dt^2, the limits are

    |q'| sqrt(x) <= v   and   |q' u + q'' x| <= a,

the second linear in x and u. On a grid, x[i + 1] = x[i] + 2 step u[i]. A backward pass finds at each point the largest
x from which the next point's set can be reached, a forward pass takes the largest u that stays inside these sets. From
rest every set holds 0, so that the sets are intervals [0, x].
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats

HALVINGS = 40
STILL = 1e-10  # |q'| below which a joint does not move along the curve


@inlined
def _u_range(
    first: Floats, second: Floats, limit: Floats, i: int, x: float, low: float, high: float
) -> tuple[float, float]:
    """Return the least and largest u in [low, high] with |q' u + q'' x| <= a at point ``i``; 1, -1 for none."""
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


@entry_point
def max_path_speeds(
    first: Floats, second: Floats, velocity: Floats, acceleration: Floats, step: float, x: Floats
) -> None:
    """Find the largest squared path speeds along a curve, from rest to rest.

    Args:
        first: Derivatives q' by arc length at evenly spaced points, shape (n, dof).
        second: Derivatives q'', shape (n, dof) [1/rad].
        velocity: Limits, shape (dof,) [rad/s].
        acceleration: Limits, shape (dof,) [rad/s^2].
        step: Spacing of the points along the curve [rad].
        x: Gets (ds/dt)^2, shape (n,) [rad^2/s^2].
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
            least, most = _u_range(first, second, acceleration, i, at, -at / (2 * step), (x[i + 1] - at) / (2 * step))
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
        least, most = _u_range(first, second, acceleration, i, at, -at / (2 * step), (x[i + 1] - at) / (2 * step))
        if least <= most:  # rounding may leave an empty interval
            x[i + 1] = max(0.0, min(x[i + 1], at + 2 * step * most))


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
