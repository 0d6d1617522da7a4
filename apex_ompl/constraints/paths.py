"""Paths on the manifold of constraints: trees, shortcuts, optimization of control points, and exact states.

Control points are optimized with a penalty on the constraints that grows (:mod:`apex_ompl.kernel.constraints`); states
of the spline are then projected, close enough to each other that the straight lines between them are proved to keep the
tolerances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf

import numpy as np

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.proof import prove_path
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.constraints import ConstrainedTreePair, ManifoldConnection, optimize_constrained_path
from apex_ompl.kernel.path import CostSettings, optimization_buffers
from apex_ompl.paths.optimizer import Optimizer, path_grid
from apex_ompl.paths.path import SEARCH_RESOLUTION, path_length
from apex_ompl.types import Array

Check = Callable[[Array], bool]
"""Whether a path, shape (N, dof), is valid but for its constraints."""

WEIGHTS = (1e2, 1e4)  # of half the mean squared rows, in one round after the other [1/m^2, 1/rad^2]
PART = 8  # steps between two looks at the clock
SPACINGS = (0.02, 0.01, 0.005)  # of exact states, in turn until the constraints are proved [rad, max-norm]
LEAST_STATES = 129  # of a path of control points
MOVED = 0.1  # largest movement of a state by its projection [rad, max-norm]
JUMP = 3.0  # largest distance of neighboring states, as a multiple of their spacing
STIFFNESSES = (25.0, 5.0)  # factors on the stiffness in shortening
MIN_GAIN = 1e-3  # least decrease of length [rad]


class ConstrainedPaths:
    """Makes and improves paths on constraints among static obstacles.

    Attributes:
        kernel: The robot among its obstacles, with the limits of the states.
        constraints: The constraints.
        optimizer: Gives spline, weights and steps.
        is_valid: Full check of a path but for its constraints.
        stop: Asked from time to time whether to give up.
    """

    def __init__(
        self, kernel: Kernel, constraints: ConstraintSet, optimizer: Optimizer, is_valid: Check,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:  # fmt: skip
        """Work with what is given."""
        self.kernel, self.constraints, self.is_valid, self.stop = kernel, constraints, is_valid, stop
        self.optimizer = optimizer
        if constraints.user:
            terms = [ConstraintCost(constraints, weight) for weight in WEIGHTS]
            self._rounds = [Optimizer(optimizer.spline, optimizer.settings, costs=[term]) for term in terms]

    def trees(self, starts: Array, goals: Array, rng: np.random.Generator) -> ConstrainedTreePair | None:
        """Return trees between starts and goals, shape (N, dof) each; none with constraints of a user's own."""
        if self.constraints.user or self.constraints.rows is None:
            return None
        limits, ends = self.kernel.robot.arrays, np.concatenate([starts, goals])
        lower, upper = limits.lower.copy(), limits.upper.copy()
        fixed = list(self.constraints.fixed)
        still = [k for k in fixed if (ends[:, k] == ends[0, k]).all()]
        lower[still] = upper[still] = ends[0, still]
        return ConstrainedTreePair(
            self.kernel.within(lower, upper), self.constraints.rows, starts, goals, SEARCH_RESOLUTION, rng
        )

    def shortcut(self, nodes: Array, draws: int, rng: np.random.Generator) -> Array:
        """Return nodes of trees with the same ends, shape (N, dof), after attempts to join random pairs of them.

        With constraints of a user's own they are returned as they are.
        """
        if self.constraints.rows is None or self.constraints.user:
            return nodes
        connection = ManifoldConnection(self.kernel, self.constraints.rows, SEARCH_RESOLUTION)
        for pair in rng.random((draws, 2)):
            if len(nodes) < 3 or self.stop():
                break
            i, j = np.sort((pair * len(nodes)).astype(int))
            if j - i < 2:
                continue
            way = connection.between(nodes[i], nodes[j])
            if way is not None and path_length(way) < path_length(nodes[i : j + 1]) - MIN_GAIN:
                nodes = np.concatenate([nodes[:i], way, nodes[j + 1 :]])
        return nodes

    def along(self, nodes: Array) -> Array | None:
        """Return the valid path through states of the manifold, shape (N, dof), or None where there is none."""
        for spacing in SPACINGS:
            pieces = [nodes[:1]]
            for a, b in zip(nodes, nodes[1:], strict=False):
                count = max(1, int(np.ceil(np.abs(b - a).max() / spacing)))
                share = np.arange(1, count + 1)[:, None] / count
                pieces.append(a + share * (b - a))
            found = self._exact(np.concatenate(pieces), spacing)
            if found is not None:
                return found if self.is_valid(found) else None
        return None

    def of_control(self, control: Array) -> Array | None:
        """Return the valid path near the spline of control points, shape (points, dof), or None where there is none."""
        spline = self.optimizer.spline
        extent = float(np.abs(np.diff(spline.path(control), axis=0)).max(axis=1).sum())
        for spacing in SPACINGS:
            count = max(LEAST_STATES, int(np.ceil(extent / spacing)) + 1)
            states = spline.basis(np.linspace(0.0, 1.0, count)) @ control
            states[0], states[-1] = control[0], control[-1]
            found = self._exact(states, max(spacing, extent / (count - 1)))
            if found is not None:
                return found if self.is_valid(found) else None
        return None

    def improved(self, control: Array, stiffness: float = 1.0, weights: Sequence[float] = WEIGHTS) -> Array | None:
        """Return control points, shape (points, dof), of a path near the constraints and clear of obstacles, or None.

        Args:
            control: First control points.
            stiffness: Factor on the stiffness.
            weights: Weights of the constraints, in one round after the other.
        """
        if self.constraints.user:
            return self._improved_in_python(control, stiffness)
        now = np.array(control, float, order="C")
        rows = self.constraints.rows
        if rows is None:
            return now
        settings, spline = self.optimizer.settings, self.optimizer.spline
        grid, buffers = path_grid(spline, settings.samples), optimization_buffers(spline.pinned, *now.shape)
        numbers = CostSettings(
            settings.scene_margin, settings.own_margin, stiffness * settings.stiffness, settings.damping, inf,
            settings.tolerance, PART,
        )  # fmt: skip
        for weight in weights:
            damping = settings.damping
            for _ in range(0, settings.steps, PART):
                if self.stop():
                    return None
                report = optimize_constrained_path(
                    self.kernel, rows, grid, spline.pinned, now, numbers._replace(damping=damping), weight, buffers
                )
                damping = report.damping
                if report.steps < PART:
                    break
        return now

    def _improved_in_python(self, control: Array, stiffness: float) -> Array | None:
        now = np.asarray(control, float)[None]
        for one in self._rounds:
            if self.stop():
                return None
            now = one.improve(self.kernel, now, stiffness=stiffness * one.settings.stiffness).control
        return np.asarray(now[0])

    def repaired(self, control: Array) -> tuple[Array, Array] | None:
        """Return control points and states of a valid path, improved from some, shape (points, dof), or None."""
        now = self.improved(control)
        states = None if now is None else self.of_control(now)
        return None if now is None or states is None else (now, states)

    def shortened(self, control: Array) -> tuple[Array, Array] | None:
        """Return control points and states of a valid path, made stiffer where that is valid, or None."""
        found = self.repaired(control)
        if found is None:
            return None
        for factor in STIFFNESSES:
            now = self.improved(found[0], factor, WEIGHTS[-1:])
            states = None if now is None else self.of_control(now)
            if now is not None and states is not None:
                return now, states
        return found

    def fit(self, nodes: Array) -> Array:
        """Return control points, shape (points, dof), of the spline nearest to states, shape (N, dof)."""
        limits = self.kernel.robot.arrays
        return self.optimizer.spline.fit(nodes, limits.lower, limits.upper).control

    def _exact(self, states: Array, spacing: float) -> Array | None:
        """Return states moved onto the constraints, or None where they move far, jump, or are not proved to hold."""
        ends = states[[0, -1]]
        found, ok = self.constraints.project(states)
        found[[0, -1]] = ends
        if not ok[1:-1].all() or np.abs(found - states).max() > MOVED:
            return None
        if np.abs(np.diff(found, axis=0)).max(initial=0.0) > JUMP * spacing:
            return None
        return found if prove_path(self.constraints, found) else None


class ConstraintCost:
    """Term of the cost of a path, see :class:`apex_ompl.paths.cost_terms.CostTerm`, for constraints of a user's own."""

    def __init__(self, constraints: ConstraintSet, weight: float) -> None:
        """Weigh half the squared rows by ``weight``."""
        self._constraints, self._root = constraints, float(np.sqrt(weight))

    def __call__(self, states: Array, /) -> tuple[Array, Array]:
        """Return the weighted rows of all constraints at states, shape (N, dof), and their Jacobians."""
        found = [self._constraints.residual(q) for q in states]
        most, dof = max(len(r) for r, _ in found), states.shape[1]
        residuals, jacobians = np.zeros((len(states), most)), np.zeros((len(states), most, dof))
        for k, (r, jacobian) in enumerate(found):  # those in dead zones have fewer rows
            residuals[k, : len(r)], jacobians[k, : len(r)] = self._root * r, self._root * jacobian
        return residuals, jacobians
