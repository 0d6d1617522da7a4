"""Cost terms given by the user, and the Levenberg-Marquardt steps in NumPy that add them to the compiled cost.

A term is a function of states q that returns residuals r(q) and their Jacobians J(q) = dr/dq. It adds

    1 / (2 N) sum_k |r(q(u_k))|^2

to the cost of :func:`apex_ompl.kernel.path.path_cost`, at the same N samples of the path q(u) = sum_i B_i(u) P_i.
Its gradient with respect to control point P_i is 1/N sum_k B_i(u_k) J_k^T r_k. Its Gauss-Newton matrix has the blocks
1/N sum_k B_i(u_k) B_j(u_k) J_k^T J_k. The steps are those of :func:`apex_ompl.kernel.path.optimize_path`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from apex_ompl.kernel.path import LEAST_DAMPING, MOST_DAMPING, CostSettings, PathReport
from apex_ompl.kernel.products import cholesky, product, solve
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array

Evaluation = tuple[PathReport, Array, Array]
"""Cost of a path, its gradient, shape (n,), and its Gauss-Newton matrix, shape (n, n), for n free unknowns."""


class CostTerm(Protocol):
    """Function of states that adds half the mean squared norm of its residuals to the cost of a path."""

    def __call__(self, states: Array, /) -> tuple[Array, Array]:
        """Return the residuals, shape (N, m), and their Jacobians, shape (N, m, dof), at states, shape (N, dof)."""


def add_terms(
    terms: Sequence[CostTerm], spline: Spline, weights: Array, states: Array, evaluation: Evaluation
) -> Evaluation:
    """Return the evaluation of a path with the cost, gradient and matrix of user terms added.

    Args:
        terms: The terms.
        spline: Spline of the control points.
        weights: Weights B_i(u_k) of the control points at the samples, shape (N, points).
        states: The samples, shape (N, dof).
        evaluation: Evaluation without the terms.

    Raises:
        ParameterError: A term returns arrays of another shape, or numbers that are not finite.
    """
    report, gradient, gram = evaluation
    count, dof = states.shape
    for term in terms:
        residual, jacobian = (np.asarray(part, float) for part in term(states.copy()))
        check_array(residual, (count, "m"), "residuals of a cost term", finite=True)
        shape = (count, residual.shape[1], dof)
        check_array(jacobian, shape, "Jacobians of a cost term", finite=True)
        by_control = jacobian[:, :, None, :] * weights[:, None, spline.inner, None]  # (N, m, free, dof)
        rows = by_control.reshape(residual.size, -1)
        report = report._replace(cost=report.cost + 0.5 * float((residual**2).sum()) / count)
        gradient = gradient + product(rows.T, residual.reshape(-1, 1))[:, 0] / count
        gram = gram + product(rows.T, rows) / count
    return report, gradient, gram


def descend(
    evaluate: Callable[[Array], Evaluation], spline: Spline, limits: tuple[Array, Array], control: Array,
    settings: CostSettings,
) -> PathReport:  # fmt: skip
    """Take Levenberg-Marquardt steps on control points, shape (points, dof), in place.

    A step solves (G + damping A) dP = -dJ/dP with the Gauss-Newton matrix G and the Gram matrix A of the speed.
    Unknowns at a limit that the gradient pushes beyond it stay.

    Args:
        evaluate: Returns the evaluation of control points, shape (points, dof).
        spline: Spline of the control points.
        limits: Lower and upper limits, each of shape (dof,).
        control: Control points; the free ones are put inside the limits.
        settings: Damping of the first step, number of steps, and when to end.

    Returns:
        Cost of the path, the number of steps taken, and the damping of the next step.
    """
    inner, (lower, upper) = spline.inner, limits
    control[inner] = control[inner].clip(lower, upper)
    metric = np.kron(spline.gram(1)[inner, inner], np.eye(control.shape[1]))
    damping, taken = settings.damping, 0
    report, gradient, gram = evaluate(control)
    while taken < settings.steps and math.isfinite(report.cost):
        if min(report.scene_clearance, report.own_clearance) >= settings.enough:
            break
        taken += 1
        slope = gradient.reshape(spline.free, -1)
        held = ((control[inner] <= lower) & (slope > 0.0)) | ((control[inner] >= upper) & (slope < 0.0))
        moved = np.flatnonzero(~held)
        step = np.zeros_like(gradient)
        if len(moved):
            factor = cholesky((gram + damping * metric)[np.ix_(moved, moved)])
            step[moved] = solve(factor, -gradient[moved, None])[:, 0]
        better = bool(np.isfinite(step).all())
        if better:
            trial = control.copy()
            trial[inner] = (control[inner] + step.reshape(slope.shape)).clip(lower, upper)
            new = evaluate(trial)
            better = new[0].cost < report.cost
        if not better:
            damping = max(4.0 * damping, LEAST_DAMPING)
            if damping > MOST_DAMPING:
                break
            continue
        gain = report.cost - new[0].cost
        control[:], (report, gradient, gram) = trial, new
        damping = max(damping / 3.0, LEAST_DAMPING)
        if gain < settings.tolerance * report.cost:
            break
    return report._replace(steps=taken, damping=damping)
