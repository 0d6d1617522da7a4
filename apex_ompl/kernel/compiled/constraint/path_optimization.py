"""Levenberg-Marquardt steps on the control points of a path under constraints.

To the cost of :mod:`apex_ompl.kernel.compiled.path.path_cost` comes a penalty, at the same N samples:

    J(P) + weight / (2 N) sum_k |r(q(u_k))|^2,

with the rows r of :mod:`apex_ompl.kernel.compiled.constraint.rows` and their Gauss-Newton matrix J_r^T J_r.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance_cost import state_cost
from apex_ompl.kernel.compiled.check.separation import tables_hold
from apex_ompl.kernel.compiled.compilation import reassociating_entry_point, reassociating_inlined
from apex_ompl.kernel.compiled.constraint.projection import rows_view
from apex_ompl.kernel.compiled.constraint.rows import ConstraintArrays, RowBuffers, constraints_view, set_rows
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.path.path_cost import (
    Buffers,
    CostSettings,
    Numbers,
    PathCost,
    Report,
    add_sample,
    add_speed,
    buffers_view,
    clear,
    set_sample,
)
from apex_ompl.kernel.compiled.path.path_optimization import descend
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view


class ConstrainedProblem(NamedTuple):
    """Data of the cost of a path under constraints.

    Attributes:
        weights: Weights of control points at the samples, shape (N, degree + 1).
        first: The first control point that they belong to, shape (N,).
        speed_gram: Gram matrix A of the speed, shape (P, P).
        constraints: Groups of rows.
        weight: Weight of half the mean of the squared rows [1/m^2, 1/rad^2].
        share: Factor on their dead zones.
        rows: Buffers of rows.
    """

    weights: Floats
    first: Integers
    speed_gram: Floats
    constraints: ConstraintArrays
    weight: float
    share: float
    rows: RowBuffers


@reassociating_inlined
def _add_rows(m: int, weight: float, rows: RowBuffers, gradient: Floats, gram: Floats) -> float:
    """Add gradient and lower half of the matrix of m rows; return their cost."""
    dof, cost = len(gradient), 0.0
    for i in range(m):
        f, row = weight * rows.residual[i], rows.jacobian[i]
        cost += 0.5 * f * rows.residual[i]
        for d in range(dof):
            u = row[d]
            if u != 0.0:
                gradient[d] += f * u
                for e in range(d + 1):
                    gram[d, e] += weight * u * row[e]
    return cost


@reassociating_inlined
def evaluate_constrained(
    problem: ConstrainedProblem, t: RobotArrays, s: SceneArrays, w: Workspace, pinned: int, control: Floats,
    settings: CostSettings, b: Buffers, gradient: Floats, gram: Floats,
) -> PathCost:  # fmt: skip
    """Return the cost of a path; put its gradient (n,) and the upper band of its matrix (n, n) into place.

    ``clearance_cost`` of the result contains the penalty.
    """
    weights, first, dof = problem.weights, problem.first, control.shape[1]
    free = len(control) - 2 * pinned
    clear(weights.shape[1] * dof, gradient, gram)
    scene, own = settings.scene_margin, settings.own_margin
    total, share, q = 0.0, 1.0 / len(weights), b.state
    for k in range(len(weights)):
        set_sample(weights, first, k, control, t.lower, t.upper, q)
        if not tables_hold(t, q, w.half_width):
            return PathCost(math.inf, math.inf, -math.inf, -math.inf)
        cost, scene, own = state_cost(
            t, s, w, q, settings.scene_margin, settings.own_margin, b.row, b.state_gradient, b.state_gram, scene, own,
        )  # fmt: skip
        m = set_rows(t, w, q, problem.constraints, problem.share, problem.rows)
        cost += _add_rows(m, problem.weight, problem.rows, b.state_gradient, b.state_gram)
        if cost > 0.0:
            total += share * cost
            add_sample(
                share, weights[k], first[k], pinned, free, b.state_gradient, b.state_gram, gradient, gram, b.room
            )
    speed = add_speed(settings.stiffness, problem.speed_gram, pinned, control, gradient, gram)
    return PathCost(total + speed, total, scene, own)


@reassociating_entry_point
def optimize_constrained_path(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    weights: Floats, first: Integers, speed_gram: Floats, pinned: int, control: Floats, numbers: Numbers,
    bi: Integers, bf: Floats, ci: Integers, cf: Floats, weight: float, share: float, rows: int, ni: Integers,
    nf: Floats,
) -> Report:  # fmt: skip
    """Improve a path in place as :func:`apex_ompl.kernel.compiled.path.path_optimization.optimize_path` does.

    Args:
        ri: Robot, packed.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace.
        wf: Workspace.
        weights: Weights of control points at the samples, shape (N, degree + 1).
        first: The first control point that they belong to, shape (N,).
        speed_gram: Gram matrix A of the speed, shape (P, P).
        pinned: Number of control points at each end that stay.
        control: Control points.
        numbers: The fields of :class:`apex_ompl.kernel.compiled.path.path_cost.CostSettings`.
        bi: Buffers, see :func:`apex_ompl.kernel.compiled.path.path_cost.optimization_buffer_sizes`.
        bf: Buffers.
        ci: Groups of rows, packed.
        cf: Groups of rows.
        weight: Weight of half the mean of the squared rows.
        share: Factor on their dead zones.
        rows: Number of all rows.
        ni: Buffers, see :func:`apex_ompl.kernel.compiled.constraint.projection.row_buffer_sizes`.
        nf: Buffers.

    Returns:
        The fields of :class:`apex_ompl.kernel.compiled.path.path_cost.PathReport`.
    """
    t, s, constraints = robot_view(ri, rf), scene_view(si, sf, sg), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    points, dof = control.shape
    b = buffers_view(bi, bf, ((points - 2 * pinned) * dof, points, dof))
    problem = ConstrainedProblem(
        weights, first, speed_gram, constraints, weight, share, rows_view(ni, nf, (rows, dof))
    )  # fmt: skip
    c, taken, damping = descend(
        evaluate_constrained, problem, t, s, w, speed_gram, pinned, control, CostSettings(*numbers), b,
        weights.shape[1],
    )  # fmt: skip
    return c.cost, c.clearance_cost, c.scene_clearance, c.own_clearance, taken, damping
