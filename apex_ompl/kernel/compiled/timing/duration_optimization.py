"""Interior-point steps that lower the duration of a motion: the control points of a spline in time, and its spacing.

The motion is a uniform cubic B-spline in time with control points P and knot spacing h = e^u, see
:mod:`apex_ompl.timing.spline_method`. The problem is

    minimize   hurry u + calm / 2 sum (D_3 P / (jerk limit h^3))^2
    subject to |D_k P|_id <= limit_kd h^k,   k = 1, 2, 3,      lower <= P <= upper,      c_j(q(t_n)) >= margin_j

with the k-th differences D_k P, which bound velocities, accelerations and jerks, and the clearance c_j of every cluster
to every obstacle, of every pair of clusters, at samples t_n. With slacks s and multipliers z of all constraints, and
their rows a of derivatives with respect to (P, u), a step solves

    (prox M + C + sum z/s a a^T) d = -f' + sum a (mu - z (c - s)) / s,

with the gradient f' of the objective and the matrix C of its second term: a matrix with a band and one more row and
column, where the limits, divided by limit h^k, are taken as linear in u, which stays where hurry is 0.
Slacks and multipliers take the largest steps that keep them positive (a primal-dual method of interior points; Nocedal
and Wright 2006, chapter 19). mu is a share of the mean of s z, which vanishes at an optimum. M is the mass matrix of
the samples.

The margin of a pair that is nearer at the start or the goal is lower around there, so that motions may start and end
there; it grows back linearly in the distance from that end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.compilation import reassociating_entry_point, reassociating_inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.timing.duration_problem import (
    LEAST_BOUND_SLACK,
    LEAST_SLACK,
    ORDERS,
    ROWS_PER_SAMPLE,
    UNIT,
    WIDTH,
    Buffers,
    DurationSettings,
    Numbers,
    Penalize,
    Penalty,
    Problem,
    buffers_view,
    differences,
    step_difference,
)
from apex_ompl.kernel.compiled.timing.duration_rows import Ends, add_bounds, add_clearances, add_limits, list_clearances
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

LEAST_MEAN = 1e-8  # of slacks times multipliers
TO_BOUNDARY = 0.995  # share of the way to the boundary that a step takes at most


class NoPenalty(NamedTuple):
    """No further terms of the objective.

    Attributes:
        always: 0, as samples without clearances add nothing.
    """

    always: int


@reassociating_inlined
def _no_penalty(penalty: NoPenalty, t: RobotArrays, w: Workspace, q: Floats, b: Buffers) -> None:
    """Add nothing to the gradient and the matrix of a sample."""


@reassociating_inlined
def _factorize(gram: Floats) -> bool:
    """Replace the band of a matrix by that of its upper Cholesky factor."""
    n, band = gram.shape
    for k in range(n):
        row = gram[k]
        if not row[0] > 0.0:
            return False
        root = 1.0 / math.sqrt(row[0])
        for j in range(band):
            row[j] *= root
        for m in range(1, min(band, n - k)):
            f = row[m]
            if f == 0.0:
                continue
            target, source = gram[k + m, : band - m], row[m:]
            for j in range(len(target)):
                target[j] -= f * source[j]
    return True


@reassociating_inlined
def _solve_transposed(factor: Floats, x: Floats) -> None:
    """Multiply by the inverse of the transpose of a factor of :func:`_factorize` in place."""
    n, band = factor.shape
    for k in range(n):
        x[k] /= factor[k, 0]
        f, most = x[k], min(band, n - k)
        row, rest = factor[k, 1:most], x[k + 1 : k + most]
        for j in range(len(rest)):
            rest[j] -= f * row[j]


@reassociating_inlined
def _solve_factor(factor: Floats, x: Floats) -> None:
    """Multiply by the inverse of a factor of :func:`_factorize` in place."""
    n, band = factor.shape
    for k in range(n - 1, -1, -1):
        total, most = x[k], min(band, n - k)
        row, rest = factor[k, 1:most], x[k + 1 : k + most]
        for j in range(len(rest)):
            total -= row[j] * rest[j]
        x[k] = total / factor[k, 0]


@reassociating_inlined
def _newton_step(corner: float, slope: float, hurry: float, b: Buffers) -> float:
    """Solve for the step of the control points, in place of the gradient, and of u, which is returned."""
    for j in range(len(b.gradient)):
        b.gradient[j] = -b.gradient[j]
    _solve_transposed(b.gram, b.gradient)
    _solve_transposed(b.gram, b.border)
    product, square = 0.0, 0.0
    for j in range(len(b.gradient)):
        product += b.border[j] * b.gradient[j]
        square += b.border[j] * b.border[j]
    change = (-slope - product) / (corner - square) if hurry > 0.0 else 0.0
    for j in range(len(b.gradient)):
        b.gradient[j] -= change * b.border[j]
    _solve_factor(b.gram, b.gradient)
    return change


@reassociating_inlined
def _longest(value: float, change: float, share: float) -> float:
    """Return the largest share of a change, at most ``share``, that leaves a value positive."""
    return min(share, -TO_BOUNDARY * value / change) if change < 0.0 else share


@reassociating_inlined
def _sample_change(p: Problem, k: int, free: int, step: Floats, change: Floats) -> None:
    """Put the change of sample ``k`` by a step into place."""
    dof = len(change)
    for d in range(dof):
        change[d] = 0.0
    for m in range(WIDTH):
        a = p.first[k] + m - p.pinned
        if 0 <= a < free:
            for d in range(dof):
                change[d] += p.weights[k, m] * step[a * dof + d]


@reassociating_inlined
def _slack_change(b: Buffers, r: int, slack: float, change: Floats) -> float:
    """Return the change of the slack of clearance ``r``."""
    total: float = b.clearance[r] - slack
    for d in range(len(change)):
        total += b.row[r, d] * change[d]
    return total


@reassociating_inlined
def _longest_steps(
    t: RobotArrays, p: Problem, control: Floats, u: float, du: float, mu: float, now: int, largest: float, b: Buffers
) -> tuple[float, float]:
    """Return the shares of the step that slacks and multipliers allow."""
    points, dof = control.shape
    free, primal, dual, step = points - 2 * p.pinned, 1.0, 1.0, b.gradient
    for j in range(len(step)):
        if abs(step[j]) * primal > largest:
            primal = largest / abs(step[j])
    for order in range(1, ORDERS + 1):
        power = math.exp(-order * u)
        for d in range(dof):
            if not p.limits[order - 1, d] > 0.0:
                continue
            scale = power / p.limits[order - 1, d]
            for i in range(points - order):
                x = scale * differences(order, i, d, control)
                change = scale * step_difference(order, i, d, p.pinned, free, dof, step)
                v, w = order * du - change, order * du + change
                primal = _longest(1.0 - x, v, primal)
                primal = _longest(1.0 + x, w, primal)
                z = b.upper_dual[order - 1, i, d]
                dual = _longest(z, (mu - z * v) / (1.0 - x) - z, dual)
                z = b.lower_dual[order - 1, i, d]
                dual = _longest(z, (mu - z * w) / (1.0 + x) - z, dual)
    for j in range(len(step)):
        d = j % dof
        q = control[p.pinned + j // dof, d]
        upper, lower = max(t.upper[d] - q, LEAST_BOUND_SLACK), max(q - t.lower[d], LEAST_BOUND_SLACK)
        primal = _longest(upper, -step[j], primal)
        primal = _longest(lower, step[j], primal)
        dual = _longest(b.bound_dual[0, j], (mu + b.bound_dual[0, j] * step[j]) / upper - b.bound_dual[0, j], dual)
        dual = _longest(b.bound_dual[1, j], (mu - b.bound_dual[1, j] * step[j]) / lower - b.bound_dual[1, j], dual)
    for k in range(len(p.weights)):
        if b.begin[now, k] == b.begin[now, k + 1]:
            continue
        _sample_change(p, k, free, step, b.state)
        for r in range(b.begin[now, k], b.begin[now, k + 1]):
            slack, z = b.slack[now, r], b.dual[now, r]
            change = _slack_change(b, r, slack, b.state)
            primal = _longest(slack, change, primal)
            dual = _longest(z, (mu - z * change) / slack - z, dual)
    return primal, dual


@reassociating_inlined
def _take_step(
    t: RobotArrays, p: Problem, control: Floats, u: float, du: float, mu: float, now: int, primal: float, dual: float,
    b: Buffers,
) -> tuple[float, float, int]:  # fmt: skip
    """Take a step; return the new u, the sum of slacks times multipliers and the number of these."""
    points, dof = control.shape
    free, total, count, step = points - 2 * p.pinned, 0.0, 0, b.gradient
    for order in range(1, ORDERS + 1):
        power, growth = math.exp(-order * u), math.exp(order * primal * du)
        for d in range(dof):
            if not p.limits[order - 1, d] > 0.0:
                continue
            scale = power / p.limits[order - 1, d]
            for i in range(points - order):
                x = scale * differences(order, i, d, control)
                change = scale * step_difference(order, i, d, p.pinned, free, dof, step)
                after = (x + primal * change) / growth
                z = b.upper_dual[order - 1, i, d]
                z = (z + dual * ((mu - z * (order * du - change)) / (1.0 - x) - z)) * growth
                b.upper_dual[order - 1, i, d] = z
                total += z * (1.0 - after)
                z = b.lower_dual[order - 1, i, d]
                z = (z + dual * ((mu - z * (order * du + change)) / (1.0 + x) - z)) * growth
                b.lower_dual[order - 1, i, d] = z
                total += z * (1.0 + after)
                count += 2
    for k in range(len(p.weights)):
        if b.begin[now, k] == b.begin[now, k + 1]:
            continue
        _sample_change(p, k, free, step, b.state)
        for r in range(b.begin[now, k], b.begin[now, k + 1]):
            slack, z = b.slack[now, r], b.dual[now, r]
            change = _slack_change(b, r, slack, b.state)
            b.slack[now, r] = slack + primal * change
            b.dual[now, r] = z + dual * ((mu - z * change) / slack - z)
            total += b.slack[now, r] * b.dual[now, r]
            count += 1
    for j in range(len(step)):
        d, i = j % dof, p.pinned + j // dof
        q = control[i, d]
        upper, lower = max(t.upper[d] - q, LEAST_BOUND_SLACK), max(q - t.lower[d], LEAST_BOUND_SLACK)
        z = b.bound_dual[0, j]
        b.bound_dual[0, j] = z + dual * ((mu + z * step[j]) / upper - z)
        z = b.bound_dual[1, j]
        b.bound_dual[1, j] = z + dual * ((mu - z * step[j]) / lower - z)
        control[i, d] = min(max(q + primal * step[j], t.lower[d]), t.upper[d])
        total += b.bound_dual[0, j] * max(t.upper[d] - control[i, d], 0.0)
        total += b.bound_dual[1, j] * max(control[i, d] - t.lower[d], 0.0)
        count += 2
    return u + primal * du, total, count


@reassociating_inlined
def _start_duals(t: RobotArrays, p: Problem, control: Floats, u: float, mu: float, b: Buffers) -> None:
    """Give all limits the multipliers mu / s, and the clearances none."""
    points, dof = control.shape
    for order in range(1, ORDERS + 1):
        power = math.exp(-order * u)
        for d in range(dof):
            if not p.limits[order - 1, d] > 0.0:
                continue
            for i in range(points - order):
                x = power / p.limits[order - 1, d] * differences(order, i, d, control)
                b.upper_dual[order - 1, i, d], b.lower_dual[order - 1, i, d] = mu / (1.0 - x), mu / (1.0 + x)
    for j in range(len(b.gradient)):
        d = j % dof
        q = control[p.pinned + j // dof, d]
        b.bound_dual[0, j] = mu / max(t.upper[d] - q, LEAST_BOUND_SLACK)
        b.bound_dual[1, j] = mu / max(q - t.lower[d], LEAST_BOUND_SLACK)
    for k in range(len(p.weights) + 1):
        b.begin[0, k] = b.begin[1, k] = 0


@reassociating_inlined
def descend(
    t: RobotArrays, s: SceneArrays, w: Workspace, p: Problem, spacing: float, control: Floats,
    settings: DurationSettings, b: Buffers, penalize: Penalize, penalty: Penalty,
) -> tuple[float, float, float, int]:  # fmt: skip
    """Take the steps on control points, in place; arguments and result as of :func:`lower_duration`.

    Args:
        t: The robot.
        s: The scene.
        w: Workspace.
        p: The motion.
        spacing: Knot spacing, with which the motion is inside all limits [s].
        control: The control points.
        settings: Settings.
        b: Buffers.
        penalize: Adds further terms of the objective.
        penalty: Data of these; where its ``always`` is not 0, they are asked for at samples without clearances, too.
    """
    points, dof = control.shape
    unknowns = len(b.gradient)
    starts = list_clearances(t, s, w, control[0], settings.margin, 0, b.end_clearance, b.row[:0], b.end_key)
    count = list_clearances(
        t, s, w, control[points - 1], settings.margin, starts, b.end_clearance, b.row[:0], b.end_key
    )
    ends = Ends(starts, count)
    u, mu, total, worst, now, taken = math.log(spacing), settings.mean, math.inf, -math.inf, 0, 0
    _start_duals(t, p, control, u, mu, b)
    mu *= settings.decrease
    while taken < settings.steps:
        for j in range(unknowns):
            i = p.pinned + j // dof
            row = b.gram[j]
            for k in range(len(row)):
                row[k] = 0.0
            for k in range(min(WIDTH, points - p.pinned - i)):
                row[k * dof] = settings.prox * p.mass[i, k]
            b.gradient[j] = b.border[j] = 0.0
        corner, slope = add_limits(p, control, u, mu, settings, b)
        add_bounds(t, p, control, mu, b)
        worst = add_clearances(t, s, w, p, control, settings, mu, now, ends, b, penalize, penalty)
        if worst == -math.inf or not _factorize(b.gram):
            break
        du = _newton_step(corner, slope, settings.hurry, b)
        primal, dual = _longest_steps(t, p, control, u, du, mu, now, settings.largest, b)
        u, total, count = _take_step(t, p, control, u, du, mu, now, primal, dual, b)
        taken += 1
        now = 1 - now
        mu = max(settings.decrease * total / count, LEAST_MEAN)
        if total < settings.tolerance and primal > 0.5 and worst > -LEAST_SLACK * UNIT:
            break
    return math.exp(u), total, worst, taken


@reassociating_entry_point
def lower_duration(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats, weights: Floats,
    first: Integers, mass: Floats, limits: Floats, pinned: int, spacing: float, control: Floats, numbers: Numbers,
    bi: Integers, bf: Floats,
) -> tuple[float, float, float, int]:  # fmt: skip
    """Lower the duration of a motion in place; its control points (P, dof) are inside the position limits.

    Args:
        ri: Packed robot.
        rf: Packed robot.
        si: Packed scene.
        sf: Packed scene.
        sg: Packed scene.
        wi: Workspace.
        wf: Workspace.
        weights: See :class:`Problem`.
        first: See :class:`Problem`.
        mass: See :class:`Problem`.
        limits: See :class:`Problem`.
        pinned: See :class:`Problem`.
        spacing: Knot spacing, with which the motion is inside all limits [s].
        control: The control points.
        numbers: The fields of :class:`DurationSettings`.
        bi: Buffers.
        bf: Buffers.

    Returns:
        The knot spacing [s], the sum of slacks times multipliers, the least clearance over its margin before the last
        step [m], and the number of steps.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    points, dof = control.shape
    p, settings = Problem(weights, first, mass, limits, pinned), DurationSettings(*numbers)
    unknowns = (points - 2 * pinned) * dof
    b = buffers_view(bi, bf, (unknowns, WIDTH * dof, points, dof, ROWS_PER_SAMPLE * len(weights), len(weights) + 1))
    return descend(t, s, w, p, spacing, control, settings, b, _no_penalty, NoPenalty(0))
