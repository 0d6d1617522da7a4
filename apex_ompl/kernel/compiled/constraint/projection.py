"""Projection of states onto constraints by Newton's method with the pseudoinverse.

A step is dq = -J^T (J J^T + lambda I)^-1 r, inside the limits; a joint that a step takes beyond a limit stays out of
the next step.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.constraint.rows import (
    ConstraintArrays,
    RowBuffers,
    constraints_view,
    group_norm,
    set_rows,
)
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_sizes, buffer_view
from apex_ompl.kernel.compiled.robot.kinematics import place_joints
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

DAMPING = 1e-10  # lambda
LEAST_PIVOT = 1e-14

rows_view = buffer_view(RowBuffers, ("rows", "dof"))


def row_buffer_sizes(rows: int, dof: int) -> tuple[int, int]:
    """Return how many integers and floats one call needs as buffers."""
    return buffer_sizes(RowBuffers, rows=rows, dof=dof)


@inlined
def _solve(m: int, b: RowBuffers) -> bool:
    """Put (J J^T + lambda I)^-1 r of m rows into ``b.solution``, columns of blocked joints left out."""
    dof, factor, x = b.jacobian.shape[1], b.factor, b.solution
    for i in range(m):
        for k in range(i + 1):
            total = DAMPING if i == k else 0.0
            for d in range(dof):
                if not b.blocked[d]:
                    total += b.jacobian[i, d] * b.jacobian[k, d]
            for p in range(k):
                total -= factor[i, p] * factor[k, p]
            if i == k:
                if not total > LEAST_PIVOT:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, k] = total / factor[k, k]
    for i in range(m):
        total = b.residual[i]
        for p in range(i):
            total -= factor[i, p] * x[p]
        x[i] = total / factor[i, i]
    for i in range(m - 1, -1, -1):
        total = x[i]
        for p in range(i + 1, m):
            total -= factor[p, i] * x[p]
        x[i] = total / factor[i, i]
    return True


@inlined
def project(
    t: RobotArrays, w: Workspace, q: Floats, c: ConstraintArrays, share: float, tolerance: float, steps: int,
    b: RowBuffers,
) -> int:  # fmt: skip
    """Move a state onto the constraints; return the number of steps, or -1 where it is not there after the last one.

    Args:
        t: The robot.
        w: Workspace.
        q: The state, replaced by the end.
        c: The groups of rows.
        share: Factor on their dead zones.
        tolerance: Norm of all rows at which to stop.
        steps: Most steps.
        b: Buffers.
    """
    for d in range(len(q)):
        b.blocked[d] = 0
        q[d] = min(max(q[d], t.lower[d]), t.upper[d])
    for count in range(steps + 1):
        m, size = set_rows(t, w, q, c, share, b), 0.0
        for i in range(m):
            size += b.residual[i] * b.residual[i]
        if size <= tolerance * tolerance:
            return count
        if count == steps or not _solve(m, b):
            return -1
        for d in range(len(q)):
            if b.blocked[d]:
                b.blocked[d] = 0
                continue
            total = 0.0
            for i in range(m):
                total += b.jacobian[i, d] * b.solution[i]
            value = q[d] - total
            q[d] = min(max(value, t.lower[d]), t.upper[d])
            b.blocked[d] = q[d] != value
    return -1


@entry_point
def project_states(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, ci: Integers, cf: Floats, states: Floats, share: float,
    tolerance: float, steps: int, counts: Integers, bi: Integers, bf: Floats, rows: int,
) -> None:  # fmt: skip
    """Project states (N, dof) in place.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        wi: Workspace.
        wf: Workspace.
        ci: Groups of rows, packed.
        cf: Groups of rows.
        states: The states.
        share: Factor on dead zones.
        tolerance: Norm of all rows at which to stop.
        steps: Most steps.
        counts: Gets the numbers of steps, -1 for states that did not arrive, shape (N,).
        bi: Buffers, see :func:`row_buffer_sizes`.
        bf: Buffers.
        rows: Number of all rows.
    """
    t, c = robot_view(ri, rf), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    b = rows_view(bi, bf, (rows, states.shape[1]))
    for s in range(len(states)):
        counts[s] = project(t, w, states[s], c, share, tolerance, steps, b)


@entry_point
def constraint_norms(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, ci: Integers, cf: Floats, states: Floats, norms: Floats,
    bi: Integers, bf: Floats, rows: int,
) -> None:  # fmt: skip
    """Put |r| of all G groups at states (N, dof) into ``norms`` (N, G); arguments as of :func:`project_states`."""
    t, c = robot_view(ri, rf), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    b = rows_view(bi, bf, (rows, states.shape[1]))
    for s in range(len(states)):
        place_joints(t, w, states[s], c.chain, 0, len(c.chain))
        for g in range(len(c.kind)):
            norms[s, g] = group_norm(w, c, g, b)


@entry_point
def constraint_rows(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, ci: Integers, cf: Floats, q: Floats, share: float,
    bi: Integers, bf: Floats, rows: int,
) -> int:  # fmt: skip
    """Put residuals and Jacobian at a state into the buffers, return the number of rows; see :func:`project_states`."""
    t, c = robot_view(ri, rf), constraints_view(ci, cf)
    w = workspace_view(t, wi, wf)
    return set_rows(t, w, q, c, share, rows_view(bi, bf, (rows, len(q))))
