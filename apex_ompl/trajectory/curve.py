"""Paths as smooth curves: polylines whose corners are blended."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.types import Array

SAME = 1e-9  # distance of states that count as one [rad]
STRAIGHT = 1e-7  # change of direction that is none


@dataclass(frozen=True, eq=False)
class Polyline:
    """States joined by straight lines, without repeated ones.

    Attributes:
        states: Shape (N, dof).
        arc: Arc lengths of the states, the first one 0, shape (N,) [rad].
    """

    states: Array
    arc: Array

    @classmethod
    def through(cls, path: ArrayLike) -> Polyline:
        """Return the polyline through the states of a path, shape (N, dof); the ends stay as they are.

        Where all states count as one, it has the first and the last of them, or one if they are the same.
        """
        states = np.array(path, dtype=float)
        kept, rows = [0], states.tolist()
        for k, row in enumerate(rows):
            if math.dist(row, rows[kept[-1]]) > SAME:
                kept.append(k)
        last = len(states) - 1
        if kept[-1] != last and len(kept) > 1:
            kept[-1] = last  # which is next to it
        elif kept[-1] != last and not np.array_equal(states[0], states[last]):
            kept.append(last)
        states = states[kept]
        return cls(states, np.append(0.0, np.cumsum(np.linalg.norm(np.diff(states, axis=0), axis=1))))

    @property
    def length(self) -> float:
        """Its length [rad]."""
        return float(self.arc[-1])

    def at(self, places: Array) -> Array:
        """Return the states at arc lengths, shape (n, dof)."""
        found: Array = np.stack([np.interp(places, self.arc, column) for column in self.states.T], axis=1)
        return found

    def corners(self) -> Polyline:
        """Return the polyline through the ends and the states at which the direction changes; arc lengths stay."""
        directions = np.diff(self.states, axis=0) / np.diff(self.arc)[:, None]
        turns = np.linalg.norm(np.diff(directions, axis=0), axis=1) > STRAIGHT
        kept = np.concatenate([[True], turns, [True]])
        return Polyline(self.states[kept], self.arc[kept])


@dataclass(frozen=True, eq=False)
class Curve:
    """A uniform cubic B-spline whose control points lie on a polyline at even arc lengths.

    It has continuous curvature, follows straight stretches at unit speed, begins and ends with the polyline, and stays
    within any box that the polyline stays in. A corner is cut by at most a third of the distance of control points.

    Attributes:
        control: Control points, one beyond each end, shape (spans + 3, dof).
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
        """Of how many pieces it is."""
        return len(self.control) - 3

    def derivatives(self, per: int) -> tuple[Array, Array]:
        """Return first and second derivatives at ``per`` places a piece, and at the end, shape (places, dof)."""
        u = np.arange(per)[:, None] / per
        slopes = np.hstack([-((1 - u) ** 2), 3 * u**2 - 4 * u, 1 + 2 * u - 3 * u**2, u**2]) / 2.0
        bends = np.hstack([1 - u, 3 * u - 2, 1 - 3 * u, u])
        windows = np.lib.stride_tricks.sliding_window_view(self.control, 4, axis=0)[: self.spans]  # (spans, dof, 4)
        made = []
        for weights, power in ((slopes, 1), (bends, 2)):
            inner = (windows @ weights.T).transpose(0, 2, 1).reshape(-1, self.control.shape[1])
            last = self.control[-3:].T @ ((-0.5, 0.0, 0.5) if power == 1 else (1.0, -2.0, 1.0))
            made.append(np.ascontiguousarray(np.vstack([inner, last]) / self.spacing**power))
        return made[0], made[1]

    def points(self, places: Array) -> Array:
        """Return the points at arc lengths of the polyline, shape (n, dof)."""
        piece = np.clip((places / self.spacing).astype(int), 0, self.spans - 1)
        u = (places / self.spacing - piece)[:, None]
        weights = np.hstack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, 1 + 3 * u + 3 * u**2 - 3 * u**3, u**3]) / 6.0
        found: Array = np.einsum("nk,nkd->nd", weights, self.control[piece[:, None] + np.arange(4)])
        return found
