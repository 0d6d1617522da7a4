"""Gaussian-process prior of motions with white noise on the acceleration (constant velocity without noise).

The state x = (q, v) of a joint follows the linear stochastic differential equation

    dq/dt = v,   dv/dt = w(t),   w ~ GP(0, Q_C delta(t - t')),

whose transition matrix and covariance over a time t are

    Phi(t) = [[1, t], [0, 1]],   Q(t) = Q_C [[t^3/3, t^2/2], [t^2/2, t]].

Between supports x_i, a time dt apart, the mean of the process given these is

    x(t_i + t) = Lambda(t) x_i + Psi(t) x_i+1,
    Psi(t) = Q(t) Phi(dt - t)^T Q(dt)^-1,   Lambda(t) = Phi(t) - Psi(t) Phi(dt)

(Barfoot, Tong and Sarkka 2014; Mukadam, Yan and Boots 2016), which is the cubic Hermite spline. Minus the logarithm of
its density is, up to a constant, 1/2 sum_i |Phi(dt) x_i - x_i+1|^2 in the metric of Q(dt)^-1. Joints are independent
and share Q_C, so that the matrices here are those of one joint.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_integer, check_positive


@dataclass(frozen=True)
class GaussianProcess:
    """The prior on supports that are evenly spaced in time.

    Attributes:
        intervals: Number N of intervals between N + 1 supports.
        duration: Time from the first to the last support [s].
        power: Power spectral density Q_C of the acceleration [rad^2/s^3].
    """

    intervals: int
    duration: float = 1.0
    power: float = 1.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: One is out of range.
        """
        check_integer(self.intervals, "intervals", 2)
        check_positive(self.duration, "duration")
        check_positive(self.power, "power")

    @property
    def spacing(self) -> float:
        """Time dt between two supports [s]."""
        return self.duration / self.intervals

    @staticmethod
    def transition(time: float) -> Array:
        """Return Phi(t), shape (2, 2), of a time [s]."""
        return np.array([[1.0, time], [0.0, 1.0]])

    def covariance(self, time: float) -> Array:
        """Return Q(t), shape (2, 2), of a time [s]."""
        t = time
        return self.power * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])

    @cached_property
    def precision(self) -> Array:
        """Inverse of Q(dt), shape (2, 2)."""
        t = self.spacing
        return np.array([[12.0 / t**3, -6.0 / t**2], [-6.0 / t**2, 4.0 / t]]) / self.power

    def interpolation(self, time: float) -> tuple[Array, Array]:
        """Return Lambda(t) and Psi(t), shape (2, 2) each, of a time after a support [s]."""
        psi = self.covariance(time) @ self.transition(self.spacing - time).T @ self.precision
        return self.transition(time) - psi @ self.transition(self.spacing), psi

    def weights(self, count: int) -> Array:
        """Return the weights of ``count`` states of an interval, its first support and evenly spaced ones after it.

        Returns:
            Shape (count, 2, 2, 2): of a state; whether of its position or velocity; of the support before it or the one
            after it; whether of the position or the velocity there.
        """
        pairs = [self.interpolation(self.spacing * k / count) for k in range(count)]
        return np.stack([np.stack(pair, axis=1) for pair in pairs])

    def states(self, supports: Array, count: int) -> Array:
        """Return states of the interpolated motion, evenly spaced in time.

        Args:
            supports: Positions and velocities at the supports, shape (N + 1, 2, dof).
            count: Number of states of an interval, its first support among them.

        Returns:
            Positions and velocities, shape (N * count + 1, 2, dof).
        """
        check_array(supports, (self.intervals + 1, 2, "dof"), "supports")
        pairs = np.stack([supports[:-1], supports[1:]], axis=1)
        inner = np.einsum("kpsv,isvd->ikpd", self.weights(count), pairs)
        return np.concatenate([inner.reshape(-1, *supports.shape[1:]), supports[-1:]])

    def errors(self, supports: Array) -> Array:
        """Return Phi x_i - x_i+1 of supports, shape (N + 1, 2, dof); shape (N, 2, dof)."""
        predicted: Array = np.einsum("pv,ivd->ipd", self.transition(self.spacing), supports[:-1])
        return predicted - supports[1:]

    def cost(self, supports: Array) -> float:
        """Return minus the logarithm of the density of supports, shape (N + 1, 2, dof), up to a constant."""
        e = self.errors(supports)
        return 0.5 * float(np.einsum("ipd,pv,ivd->", e, self.precision, e))

    def gradient(self, supports: Array) -> Array:
        """Return the gradient of :meth:`cost`, shape (N + 1, 2, dof)."""
        weighted = np.einsum("pv,ivd->ipd", self.precision, self.errors(supports))
        found = np.zeros_like(supports)
        found[:-1] = np.einsum("vp,ivd->ipd", self.transition(self.spacing), weighted)
        found[1:] -= weighted
        return found

    @cached_property
    def inner_precision(self) -> BlockTridiagonal:
        """Inverse covariance of the inner supports given the first and the last one, of one joint: blocks (2, 2)."""
        phi, inverse = self.transition(self.spacing), self.precision
        inner = self.intervals - 1
        diagonal = np.repeat((phi.T @ inverse @ phi + inverse)[None], inner, axis=0)
        return BlockTridiagonal(diagonal, np.repeat(-(phi.T @ inverse)[None], inner - 1, axis=0))

    @cached_property
    def inner_covariance(self) -> Array:
        """Covariance of the inner supports given the first and the last one, of one joint; shape (2 N - 2, 2 N - 2)."""
        found = np.linalg.inv(self.inner_precision.dense())
        return np.asarray(0.5 * (found + found.T), float)

    def mean(self, start: Array, goal: Array) -> Array:
        """Return the mean of the supports given the first and the last one, shape (2, dof) each; (N + 1, 2, dof).

        From rest to rest this is the straight line.
        """
        supports = np.zeros((self.intervals + 1, *np.shape(start)))
        supports[0], supports[-1] = start, goal
        right = -self.gradient(supports)[1:-1]
        supports[1:-1] = (self.inner_covariance @ right.reshape(len(right) * 2, -1)).reshape(right.shape)
        return supports

    def constant_velocity(self, start: Array, goal: Array) -> Array:
        """Return supports on the straight line between two positions, shape (dof,), at constant velocity.

        Returns:
            Shape (N + 1, 2, dof).
        """
        shares = np.linspace(0.0, 1.0, self.intervals + 1)[:, None]
        positions = start + shares * (goal - start)
        velocities = np.broadcast_to((goal - start) / self.duration, positions.shape)
        return np.stack([positions, velocities], axis=1)

    def sample(self, mean: Array, rng: np.random.Generator, size: float) -> Array:
        """Return a sample of the prior around supports, whose first and last stay.

        Args:
            mean: Supports, shape (N + 1, 2, dof).
            rng: Source of random numbers.
            size: Largest standard deviation of a joint's position over the supports [rad]; it replaces the one that
                follows from Q_C.
        """
        root = np.linalg.cholesky(self.inner_covariance)
        spread = np.sqrt((root[::2] ** 2).sum(axis=1).max())
        inner = mean[1:-1]
        drawn = np.asarray(size / spread * root) @ rng.normal(size=(2 * len(inner), inner.shape[2]))
        return np.concatenate([mean[:1], inner + drawn.reshape(inner.shape), mean[-1:]])


class BlockTridiagonal(NamedTuple):
    """A symmetric matrix A of n x n blocks of b x b, zero but for its diagonal blocks D_i and their neighbors.

    Attributes:
        diagonal: Diagonal blocks D_i = A_i,i, symmetric, shape (n, b, b).
        upper: Blocks U_i = A_i,i+1, shape (n - 1, b, b); A_i+1,i is their transpose.
    """

    diagonal: Array
    upper: Array

    def dense(self) -> Array:
        """Return the matrix, shape (n b, n b)."""
        n, b, _ = self.diagonal.shape
        found = np.zeros((n, b, n, b))
        for i in range(n):
            found[i, :, i] = self.diagonal[i]
        for i in range(n - 1):
            found[i, :, i + 1], found[i + 1, :, i] = self.upper[i], self.upper[i].T
        return found.reshape(n * b, n * b)

    def damped(self, share: float) -> BlockTridiagonal:
        """Return the matrix with its diagonal larger by a share of itself (Marquardt 1963)."""
        diagonal = self.diagonal.copy()
        k = np.arange(diagonal.shape[1])
        diagonal[:, k, k] *= 1.0 + share
        return BlockTridiagonal(diagonal, self.upper)

    def solve(self, right: Array) -> Array:
        """Return x of A x = right, both of shape (n, b), by block elimination (Thomas), in O(n b^3).

        Raises:
            numpy.linalg.LinAlgError: A block of the elimination is singular.
        """
        n, b, _ = self.diagonal.shape
        gains, found = np.empty((max(n - 1, 0), b, b)), np.empty((n, b))
        block, rest = self.diagonal[0], right[0]
        for i in range(n - 1):
            solved = np.linalg.solve(block, np.concatenate([self.upper[i], rest[:, None]], axis=1))
            gains[i], found[i] = solved[:, :b], solved[:, b]
            block = self.diagonal[i + 1] - self.upper[i].T @ gains[i]
            rest = right[i + 1] - self.upper[i].T @ found[i]
        found[-1] = np.linalg.solve(block, rest)
        for i in range(n - 2, -1, -1):
            found[i] -= gains[i] @ found[i + 1]
        return found
