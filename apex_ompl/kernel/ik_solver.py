"""Inside the kernel: inverse kinematics by damped least squares, and the two compiled functions that Python calls.

A target is a row of ``whole`` (kind, joint a, joint b, joint c) and a row of ``parts`` (a, b, c, number, weight), three
vectors that are fixed to the frames of their joints; joint 0 is the world. Its residual is the weight times

- GAP: point b - point a - number * direction c, three numbers [m],
- FACING: direction a + number * direction b, three numbers,
- SLOPE: direction a . direction b - number, one number.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled import entry, inlined
from apex_ompl.kernel.kinematics import place_joint
from apex_ompl.kernel.tables import FIXED, REVOLUTE, Floats, Integers, RobotArrays
from apex_ompl.kernel.views import Work, robot_view, work_view

GAP, FACING, SLOPE = range(3)
A, B, C, NUMBER, WEIGHT, PARTS = 0, 3, 6, 9, 10, 11  # where the parts of a target are, and how many
MOST_DAMPING = 1e6


@inlined
def _turned(w: Work, j: int, v: Floats) -> tuple[float, float, float]:
    """Return a direction that is fixed to a joint's frame, in the world."""
    r = w.turn[j]
    return (
        r[0, 0] * v[0] + r[0, 1] * v[1] + r[0, 2] * v[2],
        r[1, 0] * v[0] + r[1, 1] * v[1] + r[1, 2] * v[2],
        r[2, 0] * v[0] + r[2, 1] * v[1] + r[2, 2] * v[2],
    )


@inlined
def _add_columns(
    t: RobotArrays, w: Work, j: int, x: tuple[float, float, float], point: bool, f: float, row: Floats
) -> None:
    """Add f times the Jacobian of a point, or of a direction, that is fixed to a joint's frame to ``row`` (3, dof)."""
    while j > 0:
        kind = t.joint_kind[j]
        if kind != FIXED:
            r, o, k = w.turn[j], w.origin[j], t.joint_source[j]
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
def _target(t: RobotArrays, w: Work, target: Integers, part: Floats, value: Floats, row: Floats) -> int:
    """Put the residual of one target into ``value`` (3,) and its Jacobian into ``row`` (3, dof).

    Returns:
        How many numbers it has.
    """
    for i in range(3):
        for k in range(row.shape[1]):
            row[i, k] = 0.0
    kind, ja, jb, jc = target[0], target[1], target[2], target[3]
    number, weight = part[NUMBER], part[WEIGHT]
    a, b = _turned(w, ja, part[A:B]), _turned(w, jb, part[B:C])
    if kind == GAP:
        c = _turned(w, jc, part[C:NUMBER])
        o, p = w.origin[ja], w.origin[jb]
        a = (a[0] + o[0], a[1] + o[1], a[2] + o[2])
        b = (b[0] + p[0], b[1] + p[1], b[2] + p[2])
        for i in range(3):
            value[i] = weight * (b[i] - a[i] - number * c[i])
        _add_columns(t, w, ja, a, True, -weight, row)
        _add_columns(t, w, jb, b, True, weight, row)
        _add_columns(t, w, jc, c, False, -weight * number, row)
        return 3
    if kind == FACING:
        for i in range(3):
            value[i] = weight * (a[i] + number * b[i])
        _add_columns(t, w, ja, a, False, weight, row)
        _add_columns(t, w, jb, b, False, weight * number, row)
        return 3
    value[0] = weight * (a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - number)
    # The Jacobian of a . b is b . Ja + a . Jb: both are made in rows of three, then summed.
    _add_columns(t, w, ja, a, False, weight, row)
    for k in range(row.shape[1]):
        row[0, k] = b[0] * row[0, k] + b[1] * row[1, k] + b[2] * row[2, k]
        row[1, k] = row[2, k] = 0.0
    _add_slope(t, w, jb, b, a, weight, row)
    return 1


@inlined
def _add_slope(
    t: RobotArrays, w: Work, j: int, x: tuple[float, float, float], n: tuple[float, float, float], f: float, row: Floats
) -> None:
    """Add f n . J, J the Jacobian of a direction x fixed to a joint's frame, to the first of ``row`` (3, dof)."""
    while j > 0:
        if t.joint_kind[j] == REVOLUTE:
            r = w.turn[j]
            across = (
                r[1, 2] * x[2] - r[2, 2] * x[1],
                r[2, 2] * x[0] - r[0, 2] * x[2],
                r[0, 2] * x[1] - r[1, 2] * x[0],
            )
            part = n[0] * across[0] + n[1] * across[1] + n[2] * across[2]
            row[0, t.joint_source[j]] += f * t.joint_ratio[j] * part
        j = t.joint_parent[j]


@inlined
def _normal_equations(
    t: RobotArrays, w: Work, q: Floats, chain: Integers, free: Integers, whole: Integers, parts: Floats,
    value: Floats, row: Floats, gram: Floats, slope: Floats,
) -> float:  # fmt: skip
    """Put J^T J and J^T r of all targets at a state into ``gram`` (n, n) and ``slope`` (n,); return the norm of r."""
    for j in chain:
        place_joint(t, w, q, j)
    n = len(free)
    for i in range(n):
        slope[i] = 0.0
        for k in range(n):
            gram[i, k] = 0.0
    total = 0.0
    for m in range(len(whole)):
        rows = _target(t, w, whole[m], parts[m], value, row)
        for r in range(rows):
            total += value[r] * value[r]
            for i in range(n):
                u = row[r, free[i]]
                if u != 0.0:
                    slope[i] += u * value[r]
                    for k in range(i + 1):
                        gram[i, k] += u * row[r, free[k]]
    return math.sqrt(total)


@inlined
def _solve(gram: Floats, damping: float, factor: Floats, step: Floats) -> bool:
    """Solve (gram + damping I) x = step in place, by Cholesky's factors; the lower half of ``gram`` counts."""
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


@entry
def descend(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, chain: Integers, free: Integers, whole: Integers, parts: Floats,
    states: Floats, errors: Floats, counts: Integers, settings: Floats, scratch: Floats,
) -> None:  # fmt: skip
    """Descend from each of ``states`` (N, dof), which is where the ends are put, inside the limits.

    Levenberg and Marquardt's method (Nocedal and Wright 2006, section 10.3): the damping shrinks by 3 where a step
    brings the residual down, and grows by 4 where it does not.

    ``chain`` lists the joints to place, parents first, ``free`` (n,) the planned joints that may move, ``settings``
    holds the norm to stop at, most steps, and the first damping. ``errors`` and ``counts`` (N,) get the norms of the
    residuals at the ends, and the steps taken.
    """
    t = robot_view(ri, rf)
    w = work_view(t, wi, wf)
    dof, n = states.shape[1], len(free)
    value, row = scratch[:3], scratch[3 : 3 + 3 * dof].reshape(3, dof)
    at = 3 + 3 * dof
    grams = scratch[at : at + 2 * n * n].reshape(2, n, n)
    factor = scratch[at + 2 * n * n : at + 3 * n * n].reshape(n, n)
    at += 3 * n * n
    slopes = scratch[at : at + 2 * n].reshape(2, n)
    step, trial = scratch[at + 2 * n : at + 3 * n], scratch[at + 3 * n : at + 3 * n + dof]
    tolerance, most = settings[0], settings[1]
    for s in range(len(states)):
        q, now = states[s], 0
        for i in range(n):
            k = free[i]
            q[k] = min(max(q[k], t.lower[k]), t.upper[k])
        for i in range(dof):
            trial[i] = q[i]
        damping = settings[2]
        error = _normal_equations(t, w, q, chain, free, whole, parts, value, row, grams[now], slopes[now])
        count = 0
        while count < most and error > tolerance:
            count += 1
            for i in range(n):
                step[i] = -slopes[now, i]
            better = _solve(grams[now], damping, factor, step)
            new_error = error
            if better:
                for i in range(n):
                    k = free[i]
                    trial[k] = min(max(q[k] + step[i], t.lower[k]), t.upper[k])
                new_error = _normal_equations(
                    t, w, trial, chain, free, whole, parts, value, row, grams[1 - now], slopes[1 - now]
                )
                better = new_error < error
            if better:
                for i in range(n):
                    q[free[i]] = trial[free[i]]
                error, now = new_error, 1 - now
                damping = max(damping / 3.0, 1e-9)
            else:
                damping *= 4.0
                if damping > MOST_DAMPING:
                    break
        errors[s], counts[s] = error, count


@entry
def residual(
    ri: Integers, rf: Floats, wi: Integers, wf: Floats, chain: Integers, whole: Integers, parts: Floats, q: Floats,
    values: Floats, rows: Floats, row: Floats,
) -> None:  # fmt: skip
    """Put the residual of all targets at a state, (dof,), into ``values`` (m,) and its Jacobian into ``rows`` (m, dof).

    ``row`` (4, dof) is to work in.
    """
    t = robot_view(ri, rf)
    w = work_view(t, wi, wf)
    for j in chain:
        place_joint(t, w, q, j)
    at = 0
    for m in range(len(whole)):
        count = _target(t, w, whole[m], parts[m], row[3], row[:3])
        for i in range(count):
            values[at] = row[3, i]
            for k in range(len(q)):
                rows[at, k] = row[i, k]
            at += 1
