"""Motion planning on a Gaussian-process prior: GPMP2's factor graph, and GPMP's functional gradient.

The unknowns are the inner supports theta = (q_i, v_i) of
:class:`apex_ompl.baselines.gpmp.gaussian_process.GaussianProcess`; the first and the last support are fixed, which is
the limit of priors without variance. Clearances count at the supports and at states interpolated between them.
Nothing here knows OMPL; clearances are handed in. GPMP2 (Dong, Mukadam, Dellaert and Boots, RSS 2016; Mukadam et al.,
IJRR 2018) finds the maximum of the posterior, J(theta) = 1/2 sum_i |Phi x_i - x_i+1|^2_Q + 1/2 (eps / sigma)^2 sum_k
|r(q_k)|^2 + 1/2 sum_k |l(q_k) / sigma_l|^2, by Levenberg-Marquardt steps whose normal equations are block-
tridiagonal; r are the violations of the safety distance eps as shares of it, l those of the joint limits. GPMP
(Mukadam, Yan and Boots, ICRA 2016) minimizes U(theta) = 1/2 sum_i |Phi x_i - x_i+1|^2_Q + (eps / sigma)^2 int 1/2
|r(q(t))|^2 |q'(t)| dt by steps along its functional gradient theta - mu + K g: g is the gradient of the integral,
over the length of the path, at interpolated states mapped back to the supports, K the covariance of the supports
given the ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from apex_ompl.baselines.gpmp.gaussian_process import BlockTridiagonal, GaussianProcess
from apex_ompl.kernel.path import ClearanceCosts
from apex_ompl.types import Array

Clearances = Callable[[Array, Array], ClearanceCosts]
"""Clearance costs of states, shape (K, dof), at times, shape (K,) [s from the first support]."""

DAMPING, MOST_DAMPING = 1e-5, 1e8  # at first, and where steps are given up
STAYS = 1e-6  # range of a joint below which it does not move [rad]
SLOWEST = 1e-9  # speed below which its direction counts as none [rad/s]
HALVINGS = 12
PROJECTIONS = 20


def never() -> bool:
    """Return that nothing is to be ended."""
    return False


class Evaluation(NamedTuple):
    """Cost of a motion and its derivatives.

    Attributes:
        cost: The cost.
        gradient: Its gradient by the inner supports, shape (N - 1, 2, dof).
        matrix: Its Gauss-Newton matrix, of blocks (2 dof, 2 dof); of the prior alone for GPMP, of blocks (2, 2).
        clearance: Least clearances at the states that count, to obstacles and of the robot to itself, at most the
            safety distances, shape (2,) [m].
    """

    cost: float
    gradient: Array
    matrix: BlockTridiagonal
    clearance: Array


class Optimum(NamedTuple):
    """What an optimization came to.

    Attributes:
        supports: Positions and velocities, shape (N + 1, 2, dof).
        evaluation: Their cost.
        first_cost: Cost of where it started.
        iterations: Number of steps taken.
        evaluations: Number of motions whose cost was computed.
        converged: Whether the cost fell by less than the tolerance in the end.
    """

    supports: Array
    evaluation: Evaluation
    first_cost: float
    iterations: int
    evaluations: int
    converged: bool


@dataclass(frozen=True)
class Factors:
    """What both planners count besides the prior.

    Attributes:
        process: The prior.
        clearances: Clearance costs of states.
        lower: Lower limits of the positions, shape (dof,).
        upper: Upper limits; joints whose limits are the same stay.
        checked: Number of states of an interval that count, its first support among them.
        weight: Weight (eps / sigma)^2 of the clearance costs.
        limit_sigma: Standard deviation sigma_l of a violated limit [rad].
    """

    process: GaussianProcess
    clearances: Clearances
    lower: Array
    upper: Array
    checked: int
    weight: float
    limit_sigma: float = 1e-3

    @cached_property
    def weights(self) -> Array:
        """Weights of the checked states of an interval, see :meth:`GaussianProcess.weights`."""
        return self.process.weights(self.checked)

    @cached_property
    def times(self) -> Array:
        """Times of the checked states, shape (N * checked,) [s]."""
        return np.asarray(np.arange(self.process.intervals * self.checked) * (self.process.spacing / self.checked))

    def costs(self, positions: Array) -> ClearanceCosts:
        """Return the clearance costs of positions, shape (K, dof), which count at the limits where they exceed these.

        Derivatives by joints that exceed their limits or stay are 0.
        """
        inside = np.clip(positions, self.lower, self.upper)
        found = self.clearances(inside, self.times)
        still = (inside != positions) | (self.upper - self.lower < STAYS)
        found.gradient[still] = 0.0
        found.gram[still] = 0.0
        found.gram.transpose(0, 2, 1)[still] = 0.0
        return found

    def path(self, supports: Array, least: int) -> Array:
        """Return at least so many states of a motion, evenly spaced in time and within the limits, shape (K, dof)."""
        count = -(-(least - 1) // self.process.intervals)
        inside: Array = np.clip(self.process.states(supports, count)[:, 0], self.lower, self.upper)
        inside[0], inside[-1] = supports[0, 0], supports[-1, 0]
        return inside

    def _spread(self, by_state: Array, role: int) -> Array:
        """Return gradients by checked states, shape (N, checked, dof), mapped to inner supports, shape (N - 1, 2, dof).

        Args:
            by_state: The gradients.
            role: 0 where they are by positions, 1 where they are by velocities.
        """
        found = np.zeros((self.process.intervals + 1, 2, by_state.shape[2]))
        found[:-1] = np.einsum("kv,ikd->ivd", self.weights[:, role, 0], by_state)
        found[1:] += np.einsum("kv,ikd->ivd", self.weights[:, role, 1], by_state)
        return found[1:-1]


@dataclass(frozen=True)
class FactorGraph(Factors):
    """The factor graph of GPMP2, and its maximum a posteriori by Levenberg-Marquardt steps."""

    def evaluate(self, supports: Array) -> Evaluation:
        """Return what supports cost, shape (N + 1, 2, dof)."""
        process, (count, dof) = self.process, (self.process.intervals, supports.shape[2])
        positions = process.states(supports, self.checked)[:-1, 0]
        found = self.costs(positions)
        beyond = positions - np.clip(positions, self.lower, self.upper)
        stiff = self.limit_sigma**-2
        cost = process.cost(supports) + self.weight * found.cost.sum() + 0.5 * stiff * float((beyond**2).sum())
        by_state = (self.weight * found.gradient + stiff * beyond).reshape(count, self.checked, dof)
        gram = self.weight * found.gram
        joints = np.arange(dof)
        gram[:, joints, joints] += stiff * (beyond != 0.0)
        gradient = process.gradient(supports)[1:-1] + self._spread(by_state, 0)
        return Evaluation(float(cost), gradient, self._matrix(gram), found.clearance.min(axis=0))

    def _matrix(self, gram: Array) -> BlockTridiagonal:
        """Return the Gauss-Newton matrix of all factors from that of the checked states, shape (K, dof, dof)."""
        count, dof = self.process.intervals, gram.shape[1]
        before, after = self.weights[:, 0, 0], self.weights[:, 0, 1]
        flat = gram.reshape(count, self.checked, dof * dof)

        def blocks(first: Array, second: Array, chosen: Array) -> Array:
            pairs = np.einsum("kv,kw->vwk", first, second).reshape(4, self.checked)
            made = (pairs @ chosen).reshape(len(chosen), 2, 2, dof, dof).transpose(0, 1, 3, 2, 4)
            return np.asarray(made.reshape(len(chosen), 2 * dof, 2 * dof))

        prior, eye = self.process.inner_precision, np.eye(dof)
        diagonal = np.kron(prior.diagonal[0], eye) + blocks(before, before, flat[1:])
        diagonal += blocks(after, after, flat[:-1])
        upper = blocks(before, after, flat[1:-1])
        if len(upper):
            upper += np.kron(prior.upper[0], eye)
        return BlockTridiagonal(diagonal, upper)

    def maximum(
        self, supports: Array, iterations: int, tolerance: float, damping: float = DAMPING,
        stop: Callable[[], bool] = never,
    ) -> Optimum:  # fmt: skip
        """Return the maximum of the posterior that Levenberg-Marquardt steps find.

        The damping, a share of the diagonal, falls to a tenth after a step that lowers the cost, and grows tenfold
        after one that does not.

        Args:
            supports: Where to start, shape (N + 1, 2, dof).
            iterations: Most motions that are tried.
            tolerance: A step that lowers the cost by less than this share is the last.
            damping: Damping of the first step.
            stop: Asked before each step whether to end.
        """
        best = first = self.evaluate(supports)
        taken, tried, converged = 0, 0, False
        while tried < iterations and damping <= MOST_DAMPING and not stop():
            right = -best.gradient.reshape(len(best.gradient), -1)
            trial = supports.copy()
            trial[1:-1] += best.matrix.damped(damping).solve(right).reshape(best.gradient.shape)
            found, tried = self.evaluate(trial), tried + 1
            if not found.cost < best.cost:
                damping *= 10.0
                continue
            converged = best.cost - found.cost <= tolerance * best.cost
            supports, best, taken, damping = trial, found, taken + 1, max(0.1 * damping, 1e-12)
            if converged:
                break
        return Optimum(supports, best, first.cost, taken, tried + 1, converged or damping > MOST_DAMPING)


@dataclass(frozen=True)
class CostFunctional(Factors):
    """The cost functional of GPMP, and its minimization along the functional gradient."""

    def evaluate(self, supports: Array) -> Evaluation:
        """Return what supports cost, shape (N + 1, 2, dof)."""
        process, (count, dof) = self.process, (self.process.intervals, supports.shape[2])
        states = process.states(supports, self.checked)[:-1]
        found = self.costs(states[:, 0])
        speed = np.linalg.norm(states[:, 1], axis=1)
        share = self.weight * process.spacing / self.checked
        cost = process.cost(supports) + share * float(found.cost @ speed)
        shape = count, self.checked, dof
        by_position = share * speed[:, None] * found.gradient
        by_velocity = share * (found.cost / np.maximum(speed, SLOWEST))[:, None] * states[:, 1]
        gradient = process.gradient(supports)[1:-1]
        gradient = gradient + self._spread(by_position.reshape(shape), 0) + self._spread(by_velocity.reshape(shape), 1)
        return Evaluation(cost, gradient, process.inner_precision, found.clearance.min(axis=0))

    def direction(self, gradient: Array) -> Array:
        """Return the functional gradient K g of a gradient by the inner supports, each of shape (N - 1, 2, dof)."""
        flat = gradient.reshape(-1, gradient.shape[2])
        return (self.process.inner_covariance @ flat).reshape(gradient.shape)

    def within_limits(self, supports: Array) -> Array:
        """Return supports whose positions are brought within the limits, smoothly: CHOMP's projection (2009).

        Where a joint exceeds a limit it is moved by the column of K of its worst support, until none exceeds any; what
        is left after some rounds is clipped.
        """
        covariance, found = self.process.inner_covariance, supports.copy()
        inner = found[1:-1].reshape(-1, found.shape[2])  # a view
        for _ in range(PROJECTIONS):
            beyond = np.clip(inner[::2], self.lower, self.upper) - inner[::2]
            worst = np.argmax(np.abs(beyond), axis=0)
            if not beyond.any():
                break
            columns = covariance[:, 2 * worst] / covariance[2 * worst, 2 * worst]
            inner += columns * beyond[worst, np.arange(len(worst))]
        np.clip(inner[::2], self.lower, self.upper, out=inner[::2])
        return found

    def minimum(
        self, supports: Array, iterations: int, tolerance: float, *, rate: float = 1.0, largest: float = 0.3,
        accepts: Callable[[Array, Evaluation], bool] = lambda supports, evaluation: False,
        stop: Callable[[], bool] = never,
    ) -> Optimum:  # fmt: skip
        """Return what steps along the functional gradient come to.

        Args:
            supports: Where to start, shape (N + 1, 2, dof).
            iterations: Most motions that are tried.
            tolerance: A step that lowers the cost by less than this share is the last.
            rate: Length 1 / eta of a step, as a multiple of the functional gradient; halved while the cost grows, and
                doubled after a step up to this.
            largest: Largest change of a position in a step [rad].
            accepts: Asked about each motion whether it is good enough already.
            stop: Asked before each step whether to end.
        """
        best = first = self.evaluate(supports)
        length, taken, tried, converged = rate, 0, 0, False
        while tried < iterations and not converged and not stop() and not accepts(supports, best):
            way = self.direction(best.gradient)
            step = min(length, largest / max(float(np.abs(way[:, 0]).max()), 1e-12))
            for _ in range(HALVINGS):
                trial = supports.copy()
                trial[1:-1] -= step * way
                trial = self.within_limits(trial)
                found, tried = self.evaluate(trial), tried + 1
                if found.cost < best.cost or tried >= iterations:
                    break
                step *= 0.5
            if not found.cost < best.cost:
                converged = tried < iterations
                break
            converged = best.cost - found.cost <= tolerance * best.cost
            supports, best, taken, length = trial, found, taken + 1, min(2.0 * step, rate)
        return Optimum(supports, best, first.cost, taken, tried + 1, converged)
