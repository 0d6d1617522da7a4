"""Inverse kinematics by damped least squares (Levenberg and Marquardt) on weighted targets.

A target has three vectors a, b, c, fixed to the frames of its joints (joint 0 is the world), a value and a weight. Its
residual, all in the world, is the weight times

- OFFSET: point b - point a - value * direction c, three numbers [m],
- OPPOSITION: direction a + value * direction b, three numbers,
- ANGLE: direction a . direction b - value, one number.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, RobotArrays, robot_view
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_sizes, buffer_view, table_view
from apex_ompl.kernel.compiled.robot.kinematics import place_joints
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

OFFSET, OPPOSITION, ANGLE = range(3)


class TargetArrays(NamedTuple):
    """Arrays of targets, one row each.

    Attributes:
        kind: OFFSET, OPPOSITION or ANGLE.
        joints: Joints of a, b and c.
        vectors: Vectors a, b and c in their frames [m, or of length 1].
        value: The value.
        weight: The weight.
    """

    kind: Integers
    joints: Annotated[Integers, 3]
    vectors: Annotated[Floats, 3, 3]
    value: Floats
    weight: Floats


targets_view = table_view(TargetArrays)


@inlined
def _rotated(w: Workspace, j: int, v: Floats) -> tuple[float, float, float]:
    """Return a direction that is fixed to a joint's frame, in the world."""
    r = w.rotation[j]
    return (
        r[0, 0] * v[0] + r[0, 1] * v[1] + r[0, 2] * v[2],
        r[1, 0] * v[0] + r[1, 1] * v[1] + r[1, 2] * v[2],
        r[2, 0] * v[0] + r[2, 1] * v[1] + r[2, 2] * v[2],
    )


@inlined
def _add_columns(
    t: RobotArrays, w: Workspace, j: int, x: tuple[float, float, float], point: bool, f: float, row: Floats
) -> None:
    """Add f times the Jacobian of a point, or of a direction, that is fixed to a joint's frame to ``row`` (3, dof)."""
    while j > 0:
        kind = t.joint_kind[j]
        if kind != FIXED:
            r, o, k = w.rotation[j], w.origin[j], t.joint_source[j]
            scale = f * t.joint_ratio[j]
            if kind == REVOLUTE:
                u, v, z = x[0], x[1], x[2]
                if point:
                    u, v, z = u - o[0], v - o[1], z - o[2]
                row[0, k] += scale * (r[1, 2] * z - r[2, 2] * v)
                row[1, k] += scale * (r[2, 2] * u - r[0, 2] * z)
                row[2, k] += scale * (r[0, 2] * v - r[1, 2] * u)
            elif point:
                for i in range(3):
                    row[i, k] += scale * r[i, 2]
        j = t.joint_parent[j]


@inlined
def linearize(t: RobotArrays, w: Workspace, targets: TargetArrays, m: int, residual: Floats, row: Floats) -> int:
    """Put the residual of target ``m`` into ``residual`` (3,) and its Jacobian into ``row`` (3, dof).

    Returns:
        How many numbers the residual has.
    """
    for i in range(3):
        for k in range(row.shape[1]):
            row[i, k] = 0.0
    ja, jb, jc = targets.joints[m, 0], targets.joints[m, 1], targets.joints[m, 2]
    value, weight, vectors = targets.value[m], targets.weight[m], targets.vectors[m]
    a, b = _rotated(w, ja, vectors[0]), _rotated(w, jb, vectors[1])
    if targets.kind[m] == OFFSET:
        c = _rotated(w, jc, vectors[2])
        o, p = w.origin[ja], w.origin[jb]
        a = (a[0] + o[0], a[1] + o[1], a[2] + o[2])
        b = (b[0] + p[0], b[1] + p[1], b[2] + p[2])
        for i in range(3):
            residual[i] = weight * (b[i] - a[i] - value * c[i])
        _add_columns(t, w, ja, a, True, -weight, row)
        _add_columns(t, w, jb, b, True, weight, row)
        _add_columns(t, w, jc, c, False, -weight * value, row)
        return 3
    if targets.kind[m] == OPPOSITION:
        for i in range(3):
            residual[i] = weight * (a[i] + value * b[i])
        _add_columns(t, w, ja, a, False, weight, row)
        _add_columns(t, w, jb, b, False, weight * value, row)
        return 3
    residual[0] = weight * (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - value)
    # The Jacobian of a . b is b . Ja + a . Jb: the rows of Ja are summed in place.
    _add_columns(t, w, ja, a, False, weight, row)
    for k in range(row.shape[1]):
        row[0, k] = b[0] * row[0, k] + b[1] * row[1, k] + b[2] * row[2, k]
        row[1, k] = row[2, k] = 0.0
    _add_projected_columns(t, w, jb, b, a, weight, row)
    return 1


@inlined
def _add_projected_columns(
    t: RobotArrays,
    w: Workspace,
    j: int,
    x: tuple[float, float, float],
    n: tuple[float, float, float],
    f: float,
    row: Floats,
) -> None:
    """Add f n . J, J the Jacobian of a direction x fixed to a joint's frame, to the first row of ``row`` (3, dof)."""
    while j > 0:
        if t.joint_kind[j] == REVOLUTE:
            r = w.rotation[j]
            across = (
                r[1, 2] * x[2] - r[2, 2] * x[1],
                r[2, 2] * x[0] - r[0, 2] * x[2],
                r[0, 2] * x[1] - r[1, 2] * x[0],
            )
            part = n[0] * across[0] + n[1] * across[1] + n[2] * across[2]
            row[0, t.joint_source[j]] += f * t.joint_ratio[j] * part
        j = t.joint_parent[j]


LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e6
FIRST_DAMPING = 1e-2
NEARER = 0.05  # weight of the sum of squares beside that of high powers
LEAST_SIZE = 1e-6
LEAST_DECREASE = 1e-3  # of the merit function in a step, relative


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
def solve_damped(gram: Floats, damping: float, factor: Floats, step: Floats) -> bool:
    """Solve (gram + damping I) x = step in place, by Cholesky factors; only the lower half of ``gram`` is read.

    Returns:
        Whether it is positive definite.
    """
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
            better = solve_damped(b.gram[now], damping, b.factor, b.step)
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


@inlined
def _nearness(
    t: RobotArrays, w: Workspace, q: Floats, chain: Integers, free: Integers, targets: TargetArrays, start: Floats,
    reach: Floats, size: float, power: int, weight: float, b: Buffers, gram: Floats, gradient: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Put Hessian (lower half) and gradient of the merit function of :func:`approach` at a state into the buffers.

    Returns:
        The merit function and |r|.
    """
    error = _normal_equations(t, w, q, chain, free, targets, b, gram, gradient)
    merit, n = 0.5 * weight * error * error, len(free)
    for i in range(n):
        unit = 1.0 / (size * reach[free[i]])
        u = (q[free[i]] - start[free[i]]) * unit
        high = 1.0  # u^(power - 2)
        for _ in range(power // 2 - 1):
            high *= u * u
        merit += u * u * (high / power + 0.5 * NEARER)
        gradient[i] = weight * gradient[i] + unit * u * (high + NEARER)
        for k in range(i + 1):
            gram[i, k] *= weight
        gram[i, i] += unit * unit * ((power - 1.0) * high + NEARER)
    return merit, error


@entry_point
def approach(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, chain: Integers, free: Integers, ti: Integers, tf: Floats,
    start: Floats, reach: Floats, power: int, weight: float, states: Floats, errors: Floats, counts: Integers,
    max_steps: int, bi: Integers, bf: Floats,
) -> None:  # fmt: skip
    """Move each of ``states`` (N, dof) towards a start, inside the limits, with the targets as a penalty.

    With u_i = (q_i - start_i) / (s reach_i), where s makes the largest u_i of the first state 1, it minimizes

        sum_i (u_i^p / p + NEARER u_i^2 / 2) + weight |r|^2 / 2

    for an even p; with growing p the largest u_i becomes what counts. Newton steps, of the residuals Gauss and
    Newton's, are damped as in :func:`descend`; joints at a limit beyond which the gradient points stay.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        wi: Workspace.
        wf: Workspace.
        chain: Joints to place, parents first.
        free: Planned joints that may move, shape (n,).
        ti: Targets, packed.
        tf: Targets.
        start: The start, shape (dof,).
        reach: Distances of the joints that count as equal, above 0, shape (dof,).
        power: p, even.
        weight: Of the residuals.
        states: First states, shape (N, dof); they are replaced by the ends.
        errors: Gets the norms |r| at the ends, shape (N,).
        counts: Gets the steps taken, shape (N,).
        max_steps: Most steps.
        bi: Buffers, see :func:`ik_buffer_sizes`.
        bf: Buffers.
    """
    t, targets = robot_view(ri, rf), targets_view(ti, tf)
    w = workspace_view(t, wi, wf)
    dof, n = states.shape[1], len(free)
    b = _buffers(bi, bf, (dof, n))
    for s in range(len(states)):
        q, now, size = states[s], 0, 0.0
        for i in range(n):
            k = free[i]
            q[k] = min(max(q[k], t.lower[k]), t.upper[k])
            size = max(size, abs(q[k] - start[k]) / reach[k])
        size = max(size, LEAST_SIZE)
        for i in range(dof):
            b.trial[i] = q[i]
        damping = FIRST_DAMPING
        merit, error = _nearness(
            t, w, q, chain, free, targets, start, reach, size, power, weight, b, b.gram[now], b.gradient[now]
        )
        count, decrease = 0, merit
        while count < max_steps and damping <= MOST_DAMPING and decrease > LEAST_DECREASE * merit:
            count += 1
            for i in range(n):
                k, slope = free[i], b.gradient[now, i]
                b.step[i] = -slope
                if (q[k] <= t.lower[k] and slope > 0.0) or (q[k] >= t.upper[k] and slope < 0.0):
                    b.step[i] = 0.0
                    for m in range(n):
                        b.gram[now, max(i, m), min(i, m)] = 1.0 if m == i else 0.0
            better = solve_damped(b.gram[now], damping, b.factor, b.step)
            if better:
                for i in range(n):
                    k = free[i]
                    b.trial[k] = min(max(q[k] + b.step[i], t.lower[k]), t.upper[k])
                new_merit, new_error = _nearness(
                    t, w, b.trial, chain, free, targets, start, reach, size, power, weight, b, b.gram[1 - now],
                    b.gradient[1 - now],
                )  # fmt: skip
                better = new_merit < merit
            if better:
                for i in range(n):
                    q[free[i]] = b.trial[free[i]]
                decrease = merit - new_merit
                merit, error, now = new_merit, new_error, 1 - now
                damping = max(damping / 3.0, LEAST_DAMPING)
            else:
                damping *= 4.0
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
