"""Inverse kinematics by damped least squares (Levenberg and Marquardt) on the targets of ``ik_targets``."""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.ik_targets import TargetArrays, linearize, targets_view
from apex_ompl.kernel.compiled.kinematics import place_joints
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_sizes, buffer_view
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e6


class Buffers(NamedTuple):
    """Memory for descents, for n free joints.

    Attributes:
        residual: Residual of a target.
        jacobian: Its Jacobian.
        gram: J^T J at the state and at the trial.
        factor: Lower Cholesky factor.
        gradient: J^T r at the state and at the trial.
        step: Right-hand side, then step.
        trial: State after the step.
    """

    residual: Annotated[Floats, 3]
    jacobian: Annotated[Floats, 3, "dof"]
    gram: Annotated[Floats, 2, "free", "free"]
    factor: Annotated[Floats, "free", "free"]
    gradient: Annotated[Floats, 2, "free"]
    step: Annotated[Floats, "free"]
    trial: Annotated[Floats, "dof"]


_buffers = buffer_view(Buffers, ("dof", "free"))


def ik_buffer_sizes(dof: int, free: int) -> tuple[int, int]:
    """Return how many integers and floats one call needs as buffers."""
    return buffer_sizes(Buffers, dof=dof, free=free)


@inlined
def _normal_equations(
    t: RobotArrays, w: Workspace, q: Floats, chain: Integers, free: Integers, targets: TargetArrays, b: Buffers,
    gram: Floats, gradient: Floats,
) -> float:  # fmt: skip
    """Put J^T J (lower half) and J^T r of all targets into ``gram`` (n, n) and ``gradient`` (n,); return |r|."""
    place_joints(t, w, q, chain, 0, len(chain))
    n = len(free)
    for i in range(n):
        gradient[i] = 0.0
        for k in range(n):
            gram[i, k] = 0.0
    total, row = 0.0, b.jacobian
    for m in range(len(targets.kind)):
        rows = linearize(t, w, targets, m, b.residual, row)
        for r in range(rows):
            total += b.residual[r] * b.residual[r]
            for i in range(n):
                u = row[r, free[i]]
                if u != 0.0:
                    gradient[i] += u * b.residual[r]
                    for k in range(i + 1):
                        gram[i, k] += u * row[r, free[k]]
    return math.sqrt(total)


@inlined
def _solve(gram: Floats, damping: float, factor: Floats, step: Floats) -> bool:
    """Solve (gram + damping I) x = step in place, by Cholesky factors; only the lower half of ``gram`` is read."""
    n = len(step)
    for i in range(n):
        for k in range(i + 1):
            total = gram[i, k] + (damping if i == k else 0.0)
            for m in range(k):
                total -= factor[i, m] * factor[k, m]
            if i == k:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, k] = total / factor[k, k]
    for i in range(n):
        total = step[i]
        for m in range(i):
            total -= factor[i, m] * step[m]
        step[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for m in range(i + 1, n):
            total -= factor[m, i] * step[m]
        step[i] = total / factor[i, i]
    return True


@entry_point
def descend(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, chain: Integers, free: Integers, ti: Integers, tf: Floats,
    states: Floats, errors: Floats, counts: Integers, tolerance: float, max_steps: int, first_damping: float,
    bi: Integers, bf: Floats,
) -> None:  # fmt: skip
    """Descend from each of ``states`` (N, dof), inside the limits, and replace it by the end.

    Levenberg and Marquardt's method (Nocedal and Wright 2006, section 10.3): a step solves
    (J^T J + damping I) dq = -J^T r; the damping shrinks by 3 where it lowers |r|, and grows by 4 where it does not.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        wi: Workspace.
        wf: Workspace.
        chain: Joints to place, parents first.
        free: Planned joints that may move, shape (n,).
        ti: Targets, packed.
        tf: Targets.
        states: First states, shape (N, dof).
        errors: Gets the norms |r| at the ends, shape (N,).
        counts: Gets the steps taken, shape (N,).
        tolerance: Norm to stop at.
        max_steps: Most steps.
        first_damping: Damping of the first step.
        bi: Buffers, see :func:`ik_buffer_sizes`.
        bf: Buffers.
    """
    t, targets = robot_view(ri, rf), targets_view(ti, tf)
    w = workspace_view(t, wi, wf)
    dof, n = states.shape[1], len(free)
    b = _buffers(bi, bf, (dof, n))
    for s in range(len(states)):
        q, now = states[s], 0
        for i in range(n):
            k = free[i]
            q[k] = min(max(q[k], t.lower[k]), t.upper[k])
        for i in range(dof):
            b.trial[i] = q[i]
        damping = first_damping
        error = _normal_equations(t, w, q, chain, free, targets, b, b.gram[now], b.gradient[now])
        count = 0
        while count < max_steps and error > tolerance:
            count += 1
            for i in range(n):
                b.step[i] = -b.gradient[now, i]
            better = _solve(b.gram[now], damping, b.factor, b.step)
            new_error = error
            if better:
                for i in range(n):
                    k = free[i]
                    b.trial[k] = min(max(q[k] + b.step[i], t.lower[k]), t.upper[k])
                new_error = _normal_equations(
                    t, w, b.trial, chain, free, targets, b, b.gram[1 - now], b.gradient[1 - now]
                )
                better = new_error < error
            if better:
                for i in range(n):
                    q[free[i]] = b.trial[free[i]]
                error, now = new_error, 1 - now
                damping = max(damping / 3.0, LEAST_DAMPING)
            else:
                damping *= 4.0
                if damping > MOST_DAMPING:
                    break
        errors[s], counts[s] = error, count


@entry_point
def residual_and_jacobian(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, chain: Integers, ti: Integers, tf: Floats, q: Floats,
    residual: Floats, jacobian: Floats, bi: Integers, bf: Floats,
) -> None:  # fmt: skip
    """Put the residual of all targets at a state, (dof,), into ``residual`` (m,), its Jacobian into (m, dof)."""
    t, targets = robot_view(ri, rf), targets_view(ti, tf)
    w = workspace_view(t, wi, wf)
    b = _buffers(bi, bf, (len(q), 0))
    place_joints(t, w, q, chain, 0, len(chain))
    at = 0
    for m in range(len(targets.kind)):
        count = linearize(t, w, targets, m, b.residual, b.jacobian)
        for i in range(count):
            residual[at] = b.residual[i]
            for k in range(len(q)):
                jacobian[at, k] = b.jacobian[i, k]
            at += 1
