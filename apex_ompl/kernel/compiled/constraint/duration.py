"""Interior-point steps that lower the duration of a motion under constraints.

To the objective of :mod:`apex_ompl.kernel.compiled.timing.duration_optimization` comes, at each sample q, half the
weighted square of the rows r(q) of :mod:`apex_ompl.kernel.compiled.constraint.rows`, with the Gauss-Newton matrix.
"""

from __future__ import annotations

from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.compilation import reassociating_entry_point, reassociating_inlined
from apex_ompl.kernel.compiled.constraint.projection import rows_view
from apex_ompl.kernel.compiled.constraint.rows import ConstraintArrays, RowBuffers, constraints_view, set_rows
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.timing.duration_optimization import descend
from apex_ompl.kernel.compiled.timing.duration_problem import (
    ROWS_PER_SAMPLE,
    WIDTH,
    Buffers,
    DurationSettings,
    Numbers,
    Problem,
    buffers_view,
)
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view


class RowPenalty(NamedTuple):
    """Penalty on rows of constraints.

    Attributes:
        always: 1, as rows are there at all samples.
        constraints: Groups of rows.
        weight: Weight of half the square of a row [1/m^2, 1/rad^2].
        share: Factor on their dead zones.
        rows: Buffers of rows.
    """

    always: int
    constraints: ConstraintArrays
    weight: float
    share: float
    rows: RowBuffers


@reassociating_inlined
def _penalize_rows(penalty: RowPenalty, t: RobotArrays, w: Workspace, q: Floats, b: Buffers) -> None:
    """Add negative gradient and lower half of the matrix of the rows at a sample."""
    rows, dof = penalty.rows, len(q)
    for i in range(set_rows(t, w, q, penalty.constraints, penalty.share, rows)):
        row = rows.jacobian[i]
        for d in range(dof):
            f = penalty.weight * row[d]
            if f != 0.0:
                b.sample_gradient[d] -= f * rows.residual[i]
                for e in range(d + 1):
                    b.sample_gram[d, e] += f * row[e]


@reassociating_entry_point
def lower_constrained_duration(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats, weights: Floats,
    first: Integers, mass: Floats, limits: Floats, pinned: int, spacing: float, control: Floats, numbers: Numbers,
    bi: Integers, bf: Floats, ci: Integers, cf: Floats, weight: float, share: float, rows: int, ni: Integers,
    nf: Floats,
) -> tuple[float, float, float, int]:  # fmt: skip
    """Lower the duration of a motion in place with a penalty on rows of constraints at its samples.

    Args:
        ri: Packed robot; this and what follows up to ``bf`` as of
            :func:`apex_ompl.kernel.compiled.timing.duration_optimization.lower_duration`.
        rf: Packed robot.
        si: Packed scene.
        sf: Packed scene.
        sg: Packed scene.
        wi: Workspace.
        wf: Workspace.
        weights: Weights of control points at the samples.
        first: The first control point that they belong to.
        mass: Band of the mass matrix of the samples.
        limits: Limits of velocity, acceleration and jerk.
        pinned: Number of control points at each end that stay.
        spacing: Knot spacing [s].
        control: The control points.
        numbers: The fields of ``DurationSettings``.
        bi: Buffers.
        bf: Buffers.
        ci: Groups of rows, packed.
        cf: Groups of rows.
        weight: Weight of half the square of a row.
        share: Factor on their dead zones.
        rows: Number of all rows.
        ni: Buffers, see :func:`apex_ompl.kernel.compiled.constraint.projection.row_buffer_sizes`.
        nf: Buffers.

    Returns:
        As ``lower_duration``.
    """
    t, s, constraints = robot_view(ri, rf), scene_view(si, sf, sg), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    points, dof = control.shape
    p, settings = Problem(weights, first, mass, limits, pinned), DurationSettings(*numbers)
    unknowns = (points - 2 * pinned) * dof
    b = buffers_view(bi, bf, (unknowns, WIDTH * dof, points, dof, ROWS_PER_SAMPLE * len(weights), len(weights) + 1))
    penalty = RowPenalty(1, constraints, weight, share, rows_view(ni, nf, (rows, dof)))
    return descend(t, s, w, p, spacing, control, settings, b, _penalize_rows, penalty)
