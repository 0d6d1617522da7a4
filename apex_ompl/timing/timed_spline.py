"""Splines in time: uniform cubic B-splines from a given state to rest, of constant jerk between their knots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from apex_ompl.timing.spline_method import spline_in_time, start_points
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_positive

PINNED = 3  # control points at each end, which are fixed by the state there
KNOT_SPACING = 0.1  # aimed at [s]
LEAST_SPANS, MOST_SPANS = 8, 40


class Start(NamedTuple):
    """State in which a motion starts: position, velocity and acceleration, each of shape (dof,)."""

    position: Array
    velocity: Array
    acceleration: Array

    @classmethod
    def at_rest(cls, q: Array) -> Start:
        """Return rest at a state, shape (dof,)."""
        return cls(q, np.zeros_like(q), np.zeros_like(q))

    @property
    def moves(self) -> bool:
        """Whether it has a velocity or an acceleration."""
        return bool(self.velocity.any() or self.acceleration.any())


class TimedSpline(NamedTuple):
    """A uniform cubic B-spline in time, from a given state to rest.

    Attributes:
        control: Control points, shape (P, dof) [rad]; the first three fix the start, the last three are the goal.
        spacing: Knot spacing [s].
        start: State in which it starts.
    """

    control: Array
    spacing: float
    start: Start

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return (len(self.control) - PINNED) * self.spacing

    @classmethod
    def along(cls, states: Array, duration: float, start: Start, goal: Array, spans: int | None = None) -> TimedSpline:
        """Return the spline whose control points are states of a motion, evenly spaced in time.

        Args:
            states: States of the motion, evenly spaced in time, shape (N, dof); the first is the start.
            duration: Its duration [s]; the spline takes a knot spacing longer, since it rounds the end, and another one
                from rest.
            start: State in which the spline starts.
            goal: Where it ends, shape (dof,).
            spans: Number of knot spacings in that duration; by default about ``KNOT_SPACING`` each.

        Raises:
            ParameterError: ``duration`` is not positive, or the states have another shape.
        """
        check_array(states, ("N", len(goal)), "states", finite=True, least=2)
        check_positive(duration, "duration")
        count = spans or int(np.clip(round(duration / KNOT_SPACING), LEAST_SPANS, MOST_SPANS))
        spacing = float(duration / count)
        given, wanted = np.linspace(0.0, 1.0, len(states)), np.linspace(0.0, 1.0, count + 1)
        states = np.stack([np.interp(wanted, given, column) for column in states.T], axis=1)
        before = 1 if start.moves else 2  # at rest the first three control points are one
        control = np.concatenate([np.repeat(states[:1], before, axis=0), states, states[-1:], states[-1:]])
        control[-PINNED:] = goal
        return cls(control, spacing, start).lasting(spacing)

    def lasting(self, spacing: float) -> TimedSpline:
        """Return the spline with another knot spacing [s] and the same start."""
        control = self.control.copy()
        control[:PINNED] = start_points(self.start, spacing)
        if not self.start.moves:
            control[:PINNED] = self.start.position
        return TimedSpline(control, spacing, self.start)

    @property
    def spans(self) -> int:
        """Number of knot spacings."""
        return len(self.control) - PINNED

    def refitted(self, spans: int) -> TimedSpline:
        """Return nearly the same motion from rest with another number of knot spacings.

        The spline with the control points q(t_i) - h^2 / 6 q''(t_i) is the same up to the fourth order of the knot
        spacing h.
        """
        spacing = self.duration / spans
        at = (np.arange(-1, spans + 2) * spacing / self.spacing).clip(0.0, self.spans * (1.0 - 1e-12))
        span = at.astype(int)
        x = at - span
        points = self.control[span[:, None] + np.arange(PINNED + 1)]
        weights = basis(x) - (spacing / self.spacing) ** 2 / 6.0 * curvatures(x)
        control = (weights[:, :, None] * points).sum(axis=1)
        control[:PINNED], control[-PINNED:] = self.start.position, self.control[-1]
        return TimedSpline(control, float(spacing), self.start)

    def trajectory(self, joint_names: Sequence[str]) -> Trajectory:
        """Return the motion itself; start and end are exact, and so are joints that stay."""
        motion = spline_in_time(self.control, self.spacing, tuple(joint_names), self.start)
        inner = motion.positions[1:-1]  # averages of control points
        np.clip(inner, self.control.min(axis=0), self.control.max(axis=0), out=inner)
        return motion


def basis(x: Array) -> Array:
    """Return the weights of the four control points of a span at shares of it, shape (N, 4)."""
    square, rest = x * x, 1 - x
    cube = square * x  # powers of NumPy differ between processors
    return np.stack([rest * rest * rest, 3 * cube - 6 * square + 4, -3 * cube + 3 * square + 3 * x + 1, cube], 1) / 6.0


def slopes(x: Array) -> Array:
    """Return the derivatives of :func:`basis` with respect to the share, shape (N, 4)."""
    return np.stack([-((1 - x) ** 2), 3 * x**2 - 4 * x, -3 * x**2 + 2 * x + 1, x**2], axis=1) / 2.0


def curvatures(x: Array) -> Array:
    """Return the second derivatives of :func:`basis` with respect to the share, shape (N, 4)."""
    return np.stack([1 - x, 3 * x - 2, 1 - 3 * x, x], axis=1)
