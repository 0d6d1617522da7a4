"""Polylines, smooth curves along them that round their corners, and the distance of a motion from a polyline."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel.products import product
from apex_ompl.kernel.timing import max_distance
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import number_array

SAME_STATE = 1e-9  # distance below which states count as one [rad]
SAME_DIRECTION = 1e-7  # norm of the difference of unit directions below which they count as one
MAX_SAMPLES = 100_000
AT_ONCE = 8_000  # samples between two calls of ``stop``
SAMPLES_PER_DEVIATION = 10.0
SPEED_MARGIN = 1.1  # largest ratio of the speed between knots to that at knots


@dataclass(frozen=True, eq=False)
class Polyline:
    """States joined by straight lines, no two neighbors the same.

    Attributes:
        states: Shape (N, dof) [rad; synergies 0..1].
        arc: Arc length up to each state, from 0, shape (N,) [rad].
    """

    states: Array
    arc: Array

    @classmethod
    def through(cls, path: ArrayLike) -> Polyline:
        """Return the polyline through the states of a path, shape (N, dof), with the same ends bit for bit.

        Where all states count as one, it has the first and the last of them, or one if these are equal.
        """
        states = np.array(number_array(path, "path"))
        kept, rows = [0], states.tolist()
        for k, row in enumerate(rows):
            if math.dist(row, rows[kept[-1]]) > SAME_STATE:
                kept.append(k)
        last = len(states) - 1
        if kept[-1] != last and len(kept) > 1:
            kept[-1] = last  # they count as one
        elif kept[-1] != last and not np.array_equal(states[0], states[last]):
            kept.append(last)
        states = states[kept]
        return cls(states, np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1))))

    @property
    def length(self) -> float:
        """Arc length [rad]."""
        return float(self.arc[-1])

    def at(self, arc: Array) -> Array:
        """Return the states at arc lengths of shape (n,) [rad], shape (n, dof)."""
        states: Array = np.stack([np.interp(arc, self.arc, column) for column in self.states.T], axis=1)
        return states

    def corners(self) -> Polyline:
        """Return the polyline through the ends and the states at which the direction changes; arc lengths are kept."""
        directions = np.diff(self.states, axis=0) / np.diff(self.arc)[:, None]
        turns = np.linalg.norm(np.diff(directions, axis=0), axis=1) > SAME_DIRECTION
        kept = np.concatenate([[True], turns, [True]])
        return Polyline(self.states[kept], self.arc[kept])


@dataclass(frozen=True, eq=False)
class Curve:
    """A uniform cubic B-spline whose control points lie on a polyline at even arc lengths.

    It is q(s) = sum_i B_i(s) P_i over the arc length s of the polyline. It has continuous curvature, follows straight
    stretches at unit speed, starts and ends with the polyline, and stays within any axis-aligned box that the polyline
    stays in. A corner is cut by at most a third of the spacing of control points.

    Attributes:
        control: Control points P_i, one beyond each end, shape (spans + 3, dof).
        spacing: Distance of control points along the polyline [rad].
    """

    control: Array
    spacing: float

    @classmethod
    def along(cls, line: Polyline, spacing: float) -> Curve:
        """Return the curve along a polyline with control points at most ``spacing`` apart [rad]."""
        spans = max(1, int(np.ceil(line.length / spacing)))
        points = line.at(np.linspace(0.0, line.length, spans + 1))
        points[0], points[-1] = line.states[0], line.states[-1]
        ends = 2.0 * points[:1] - points[1:2], 2.0 * points[-1:] - points[-2:-1]
        return cls(np.concatenate([ends[0], points, ends[1]]), line.length / spans)

    @property
    def spans(self) -> int:
        """Number of polynomial pieces."""
        return len(self.control) - 3

    def derivatives(self, per_span: int) -> tuple[Array, Array]:
        """Return q'(s) and q''(s) at ``per_span`` arc lengths a span and at the end, shape (K, dof)."""
        u = np.arange(per_span)[:, None] / per_span
        slopes = np.hstack([-((1 - u) ** 2), 3 * u**2 - 4 * u, 1 + 2 * u - 3 * u**2, u**2]) / 2.0
        curvatures = np.hstack([1 - u, 3 * u - 2, 1 - 3 * u, u])
        windows = np.lib.stride_tricks.sliding_window_view(self.control, 4, axis=0)[: self.spans]  # (spans, dof, 4)
        derivatives = []
        for weights, order in ((slopes, 1), (curvatures, 2)):
            inner = product(windows, weights.T).transpose(0, 2, 1).reshape(-1, self.control.shape[1])
            last = product(((-0.5, 0.0, 0.5) if order == 1 else (1.0, -2.0, 1.0),), self.control[-3:])
            derivatives.append(np.ascontiguousarray(np.vstack([inner, last]) / self.spacing**order))
        return derivatives[0], derivatives[1]

    def points(self, arc: Array) -> Array:
        """Return q(s) at arc lengths of the polyline of shape (n,) [rad], shape (n, dof)."""
        span = np.clip((arc / self.spacing).astype(int), 0, self.spans - 1)
        u = (arc / self.spacing - span)[:, None]
        weights = np.hstack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3]) / 6.0
        points: Array = np.einsum("nk,nkd->nd", weights, self.control[span[:, None] + np.arange(4)])
        return points


def deviation_bound(
    motion: Trajectory, line: Polyline, arc_at: tuple[Array, Array], window: float, deviation: float,
    *, stop: Callable[[], bool] = lambda: False,
) -> float:  # fmt: skip
    """Return an upper bound on the Euclidean distance of a motion from a polyline [rad].

    It is max_k d(q(t_k), line) + max_k |q(t_k+1) - q(t_k)| / 2 over samples t_k.

    Args:
        motion: The motion.
        line: The polyline.
        arc_at: Times from 0 to the end of the part that is compared, shape (K,) [s], and the arc lengths along the
            polyline that the motion reaches at them, shape (K,) [rad]; linear in between.
        window: Largest distance along the polyline from there to the nearest point [rad].
        deviation: The allowed distance; samples are a tenth of it apart [rad].
        stop: Called often; where it returns True, the bound is infinity.
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
