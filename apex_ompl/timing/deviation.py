"""Distance of a motion from the polyline that it follows."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from apex_ompl.kernel.timing import max_distance
from apex_ompl.timing.curve import Polyline
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array

MAX_SAMPLES = 100_000
AT_ONCE = 8_000  # samples between two looks at the clock
SAMPLES_PER_DEVIATION = 10.0
SPEED_MARGIN = 1.1  # largest ratio of the speed between knots to that at knots


def deviation_bound(
    motion: Trajectory, line: Polyline, arc_at: tuple[Array, Array], window: float, deviation: float,
    *, stop: Callable[[], bool] = lambda: False,
) -> float:  # fmt: skip
    """Return an upper bound on the Euclidean distance of a motion from a polyline [rad].

    It is max_k d(q(t_k), line) + max_k |q(t_k+1) - q(t_k)| / 2 over samples t_k.

    Args:
        motion: The motion.
        line: The polyline.
        arc_at: Times from 0 to the last that counts, shape (K,) [s], and the arc lengths along the polyline that the
            motion reaches at them, shape (K,) [rad]; linear in between.
        window: Largest distance along the polyline from there to the nearest point [rad].
        deviation: The distance that matters; samples are a tenth of it apart [rad].
        stop: Asked often whether to give up; then there is no bound, and infinity is returned.
    """
    end = float(arc_at[0][-1])
    speed = float(np.linalg.norm(motion.velocities, axis=1).max()) * SPEED_MARGIN
    count = min(MAX_SAMPLES, max(2, math.ceil(speed * end / (deviation / SAMPLES_PER_DEVIATION)) + 1))
    times = np.linspace(0.0, end, count)
    distance, step = 0.0, 0.0
    for first in range(0, count - 1, AT_ONCE):
        if stop():
            return math.inf
        some = times[first : first + AT_ONCE + 1]  # the last one is the first of the next
        points = motion(some)
        if len(line.states) == 1:
            farthest = float(np.linalg.norm(points - line.states[0], axis=1).max())
        else:
            farthest = max_distance(points, np.interp(some, *arc_at), line.states, line.arc, window)
        distance = max(distance, farthest)
        step = max(step, float(np.linalg.norm(np.diff(points, axis=0), axis=1).max()))
    return distance + step / 2.0
