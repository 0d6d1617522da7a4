"""Distance of a motion from the polyline that it follows."""

from __future__ import annotations

import math

import numpy as np

from apex_ompl.kernel.compiled.polyline_distance import max_distance
from apex_ompl.trajectory.curve import Polyline
from apex_ompl.trajectory.trajectory import Trajectory
from apex_ompl.types import Array

MAX_SAMPLES = 100_000
SAMPLES_PER_DEVIATION = 10.0
SPEED_MARGIN = 1.1  # largest ratio of the speed between knots to that at knots


def deviation_bound(
    motion: Trajectory, line: Polyline, arc_at: tuple[Array, Array], window: float, deviation: float
) -> float:
    """Return an upper bound on the Euclidean distance of a motion from a polyline [rad].

    It is max_k d(q(t_k), line) + max_k |q(t_k+1) - q(t_k)| / 2 over samples t_k.

    Args:
        motion: The motion.
        line: The polyline.
        arc_at: Times from 0 to the last that counts, shape (K,) [s], and the arc lengths along the polyline that the
            motion reaches at them, shape (K,) [rad]; linear in between.
        window: Largest distance along the polyline from there to the nearest point [rad].
        deviation: The distance that matters; samples are a tenth of it apart [rad].
    """
    end = float(arc_at[0][-1])
    speed = float(np.linalg.norm(motion.velocities, axis=1).max()) * SPEED_MARGIN
    count = min(MAX_SAMPLES, max(2, math.ceil(speed * end / (deviation / SAMPLES_PER_DEVIATION)) + 1))
    times = np.linspace(0.0, end, count)
    points = motion(times)
    if len(line.states) == 1:
        distance = float(np.linalg.norm(points - line.states[0], axis=1).max())
    else:
        distance = float(max_distance(points, np.interp(times, *arc_at), line.states, line.arc, window))
    half_step = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)) / 2.0
    return distance + half_step
