"""Paths as clamped B-splines: a few control points represent a path of many states."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.products import cholesky, product, solve
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct
from apex_ompl.util.validation import check_integer, check_path

FIT_SAMPLES = 1025
ROUGHNESS = 1e-9  # weight of the squared third derivative, so that a fit determines all control points


@dataclass(frozen=True)
class Spline:
    """Clamped B-splines over [0, 1] with even knots, as motion planning diffusion uses them (Carvalho et al. 2024).

    A curve lies in the convex hull of its control points, so it is inside limits where its control points are. The
    first and the last control point are the ends. With k control points pinned to an end, k - 1 derivatives vanish
    there: with 3 the curve starts and ends at rest, without acceleration.

    Attributes:
        points: Number of control points, pinned ones included.
        pinned: Number of control points at each end that coincide with it, at least 1.
        states: Number of states of a path, evenly spaced in the parameter.
        degree: Degree of the polynomials; 5 for continuous snap.
    """

    points: int = 14
    pinned: int = 1
    states: int = 256
    degree: int = 5

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: There are too few points, states or pinned points, or no free control points.
        """
        for name, low in (("degree", 1), ("pinned", 1), ("states", 2)):
            object.__setattr__(self, name, check_integer(getattr(self, name), name, low))
        object.__setattr__(self, "points", check_integer(self.points, "points", self.degree + 1))
        if self.free < 1:
            raise ParameterError("pinned", self.pinned, f"less than half of the {self.points} points")

    @property
    def free(self) -> int:
        """Number of control points that are not pinned."""
        return self.points - 2 * self.pinned

    @property
    def inner(self) -> slice:
        """Slice of the free control points among all."""
        return slice(self.pinned, self.points - self.pinned)

    @property
    def knots(self) -> Array:
        """The knots, shape (points + degree + 1,)."""
        inner = np.linspace(0.0, 1.0, self.points - self.degree + 1)
        return np.concatenate([np.zeros(self.degree), inner, np.ones(self.degree)])

    @property
    def parameters(self) -> Array:
        """Parameters of the states of a path, shape (states,)."""
        return np.linspace(0.0, 1.0, self.states)

    def basis(self, u: ArrayLike, order: int = 0) -> Array:
        """Return the weights of the control points at parameters, or derivatives of them; shape (len(u), points).

        By the recursion of de Boor (1972); a derivative of order k is with respect to the parameter.

        Raises:
            ParameterError: Parameters outside [0, 1].
        """
        values = np.atleast_1d(np.asarray(u, float))
        if values.ndim != 1 or not ((values >= 0.0) & (values <= 1.0)).all():
            raise ParameterError("u", u, "parameters in [0, 1]")
        return _basis(self.knots, self.degree, values, order)

    def line(self, start: ArrayLike, goal: ArrayLike) -> Array:
        """Return the control points of straight lines; ends of shape (..., dof), result (..., points, dof).

        With one pinned point the speed is even.
        """
        knots = self.knots
        along = np.array(
            [knots[k + 1 : k + self.degree + 1].mean() for k in range(self.points)]
        )  # Greville's abscissae
        first, last = along[self.pinned - 1], along[self.points - self.pinned]
        share = ((np.clip(along, first, last) - first) / (last - first))[:, None]
        a, b = np.asarray(start, float)[..., None, :], np.asarray(goal, float)[..., None, :]
        return self.with_ends(a + share * (b - a), start, goal)

    def with_ends(self, control: ArrayLike, start: ArrayLike, goal: ArrayLike) -> Array:
        """Return control points (..., points, dof) whose pinned ones are the ends (..., dof), bit for bit.

        Raises:
            ParameterError: Another number of control points.
        """
        points = self._checked(control).copy()
        points[..., : self.pinned, :] = np.asarray(start, float)[..., None, :]
        points[..., self.points - self.pinned :, :] = np.asarray(goal, float)[..., None, :]
        return points

    def path(self, control: ArrayLike) -> Array:
        """Return the states (..., states, dof) of control points (..., points, dof); the ends are theirs bit for bit.

        Raises:
            ParameterError: Another number of control points.
        """
        points = self._checked(control)
        # Each value is a mean of control points; rounding must not exceed limits that all of them keep.
        states = np.clip(
            product(_grid(self, 0), points), points.min(axis=-2, keepdims=True), points.max(axis=-2, keepdims=True)
        )
        states[..., 0, :], states[..., -1, :] = points[..., 0, :], points[..., -1, :]
        return np.asarray(states)

    def derivative(self, control: ArrayLike, order: int = 1) -> Array:
        """Return derivatives with respect to the parameter at the states, shape (..., states, dof).

        Raises:
            ParameterError: Another number of control points.
        """
        return product(_grid(self, order), self._checked(control))

    def gram(self, order: int) -> Array:
        """Return the integrals over [0, 1] of products of derivatives of the weights, shape (points, points).

        For control points c of one joint, c . gram(k) . c is the integral of the k-th derivative squared. Exact, by
        Gauss's quadrature on each span.
        """
        breaks = distinct(self.knots)
        at, weight = np.polynomial.legendre.leggauss(self.degree + 1)
        total = np.zeros((self.points, self.points))
        for a, b in zip(breaks[:-1], breaks[1:], strict=True):
            values = self.basis((a + b) / 2 + (b - a) / 2 * at, order)
            total += product((b - a) / 2 * (values.T * weight), values)
        return total

    def fit(self, polyline: ArrayLike, lower: ArrayLike = -np.inf, upper: ArrayLike = np.inf) -> Fit:
        """Return the least-squares fit to a polyline, shape (N, dof), that is followed at even speed.

        The ends are exact, and control points are clipped to the limits.

        Raises:
            ParameterError: The polyline has another shape, or numbers that are not finite.
        """
        line = check_path(polyline, "polyline")
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        even = self.line(line[0], line[-1])
        if along[-1] <= 0.0:
            return Fit(even, 0.0)
        u = np.linspace(0.0, 1.0, FIT_SAMPLES)
        wanted = np.stack([np.interp(u, along / along[-1], column) for column in line.T], axis=1)
        weights, factor = _fit_grid(self)
        rest = wanted - product(weights, even)
        found = solve(factor, product(weights[:, self.inner].T, rest) / len(u))
        control = even.copy()
        control[self.inner] += found
        control = self.with_ends(np.clip(control, lower, upper), line[0], line[-1])
        # Between two samples the difference changes by at most half a spacing times the speeds.
        slope = self.degree * np.abs(np.diff(control, axis=0) / _spans(self)[:, None]).max(axis=0)
        speed = np.abs(np.diff(line, axis=0) / np.maximum(steps, 1e-300)[:, None]).max(axis=0) * along[-1]
        apart = np.abs(product(weights, control) - wanted).max(axis=0) + (slope + speed) / (2 * (len(u) - 1))
        return Fit(control, float(apart.max()))

    def _checked(self, control: ArrayLike) -> Array:
        points = np.asarray(control, float)
        if points.ndim < 2 or points.shape[-2] != self.points:
            raise ParameterError("control points", points.shape, f"an array of shape (..., {self.points}, dof)")
        return points


@dataclass(frozen=True)
class Fit:
    """A curve fitted to a polyline.

    Attributes:
        control: Its control points, shape (points, dof).
        error: Bound on the distance of the curve from the polyline at equal parameters [rad, max-norm].
    """

    control: Array
    error: float


def _basis(knots: Array, degree: int, u: Array, order: int) -> Array:
    """Return derivatives of the weights of B-splines of a degree at parameters, shape (len(u), points)."""
    if order > degree:
        return np.zeros((len(u), len(knots) - degree - 1))
    if order > 0:
        lower = _basis(knots[1:-1], degree - 1, u, order - 1)  # of one point less
        steps = degree / (knots[degree + 1 : -1] - knots[1 : -degree - 1])
        zero = np.zeros((len(u), 1))
        return np.hstack([zero, lower * steps]) - np.hstack([lower * steps, zero])
    spans = len(knots) - 1
    last = int(np.searchsorted(knots, knots[-1])) - 1  # the span that holds the end of the range
    which = np.minimum(np.searchsorted(knots, u, side="right") - 1, last)
    values = np.zeros((len(u), spans))
    values[np.arange(len(u)), which] = 1.0
    for d in range(1, degree + 1):
        left, right = knots[d:-1] - knots[: -d - 1], knots[d + 1 :] - knots[1:-d]
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = np.where(left > 0.0, (u[:, None] - knots[: -d - 1]) / left, 0.0)
            fall = np.where(right > 0.0, (knots[d + 1 :] - u[:, None]) / right, 0.0)
        values = rise * values[:, :-1] + fall * values[:, 1:]
    return values


def _spans(spline: Spline) -> Array:
    """Return the spans over which neighboring control points differ, shape (points - 1,)."""
    knots = spline.knots
    return np.asarray(knots[spline.degree + 1 : -1] - knots[1 : -spline.degree - 1])


@lru_cache(maxsize=32)
def _grid(spline: Spline, order: int) -> Array:
    weights = spline.basis(spline.parameters, order)
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=8)
def _fit_grid(spline: Spline) -> tuple[Array, Array]:
    weights = spline.basis(np.linspace(0.0, 1.0, FIT_SAMPLES))
    rough, inner = spline.gram(min(3, spline.degree))[spline.inner, spline.inner], weights[:, spline.inner]
    return weights, cholesky(product(inner.T, inner) / len(weights) + ROUGHNESS * rough)
