"""Levenberg-Marquardt steps on the control points of a path, see :mod:`apex_ompl.kernel.compiled.path.path_cost`.

A step solves

    (stiffness A + H + damping A) dP = -dJ/dP,

where H sums the Gauss-Newton matrices of the samples, mapped to the control points. Damping in the metric A spreads a
step smoothly over the path (a covariant descent as CHOMP's, Zucker et al. 2013, on the least squares of GPMP2, Mukadam
et al. 2018).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.compilation import reassociating_entry_point, reassociating_inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.path.path_cost import (
    BLOCK,
    STRIDE,
    Buffers,
    CostSettings,
    Numbers,
    PathCost,
    PathProblem,
    Report,
    buffers_view,
    evaluate_path,
)
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e9
S1, S2, S3, S4, S5, S6, S7 = (np.uint64(r * STRIDE) for r in range(1, BLOCK))

Evaluate = Callable[..., PathCost]
Problem = Any


@reassociating_inlined
def _eliminate(factor: Floats, first: int, last: int, k: int, end: int) -> bool:
    """Finish row ``k`` of a Cholesky factor: subtract the products of rows ``first`` to ``last``."""
    source = factor[k, k:end]
    for m in range(first, last):
        f, row = factor[m, k], factor[m, k:end]
        for j in range(len(source)):
            source[j] -= f * row[j]
    if not source[0] > 0.0:
        return False
    root = 1.0 / math.sqrt(source[0])
    for j in range(len(source)):
        source[j] *= root
    return True


@reassociating_inlined
def _take_away(factor: Floats, k: int, last: int, end: int, panel: Floats) -> None:
    """Subtract the products of the BLOCK rows from ``k`` on from the rows below, up to ``end``.

    Pieces of the rows are copied next to each other: between rows whose distance is a constant no test is needed of
    whether they overlap, nor, with indices that cannot be negative, of where they start.
    """
    for first in range(last, end, STRIDE):
        length = min(STRIDE, end - first)
        for r in range(BLOCK):
            source, room = factor[k + r, first : first + length], panel[r * STRIDE : r * STRIDE + length]
            for j in range(length):
                room[j] = source[j]
        for i in range(last, first + length):
            a, b, c, d = factor[k, i], factor[k + 1, i], factor[k + 2, i], factor[k + 3, i]
            e, f, g, h = factor[k + 4, i], factor[k + 5, i], factor[k + 6, i], factor[k + 7, i]
            target = factor[i, first : first + length]
            for j in range(np.uint64(max(i - first, 0)), np.uint64(length)):
                left = a * panel[j] + b * panel[j + S1] + c * panel[j + S2] + d * panel[j + S3]
                target[j] -= left + (e * panel[j + S4] + f * panel[j + S5] + g * panel[j + S6] + h * panel[j + S7])


@reassociating_inlined
def _factorize(factor: Floats, band: int, panel: Floats) -> bool:
    """Replace a matrix by its upper Cholesky factor; both are zero beyond ``band`` from the diagonal.

    Rows are taken eight at a time, so that a row below is read and written once for all of them; ``panel`` (PANEL,) is
    memory.
    """
    n = len(factor)
    for k in range(0, n, BLOCK):
        last = min(n, k + BLOCK)
        end = min(n, last - 1 + band)
        for m in range(k, last):
            for j in range(min(n, m + band), end):
                factor[m, j] = 0.0
            if not _eliminate(factor, k, m, m, end):
                return False
        if last < k + BLOCK:
            break
        _take_away(factor, k, last, end, panel)
    return True


@reassociating_inlined
def _set_damped(
    gram: Floats, speed_gram: Floats, damping: float, pinned: int, dof: int, held: Integers, band: int, factor: Floats
) -> None:
    """Put the upper band of gram + damping A into ``factor``, with rows and columns of the identity for ``held``."""
    some = False
    for i in range(len(held)):
        some = some or held[i] != 0
    for i in range(len(held)):
        source, target, a = gram[i, i : i + band], factor[i, i : i + band], i // dof + pinned
        for k in range(len(source)):
            target[k] = source[k]
        for k in range(0, len(target), dof):
            target[k] += damping * speed_gram[a, a + k // dof]
        if some:
            for k in range(len(target)):
                if held[i] or held[i + k]:
                    target[k] = 0.0
            if held[i]:
                target[0] = 1.0


@reassociating_inlined
def _newton_step(
    gram: Floats, speed_gram: Floats, damping: float, pinned: int, dof: int, held: Integers, band: int, factor: Floats,
    panel: Floats, step: Floats,
) -> bool:  # fmt: skip
    """Solve (gram + damping A) x = step in place, with x = 0 for ``held`` unknowns; False if not positive definite."""
    n = len(step)
    _set_damped(gram, speed_gram, damping, pinned, dof, held, band, factor)
    for i in range(n):
        if held[i]:
            step[i] = 0.0
    if not _factorize(factor, band, panel):
        return False
    for i in range(n):
        step[i] /= factor[i, i]
        row, rest = factor[i, i + 1 : min(n, i + band)], step[i + 1 : min(n, i + band)]
        for j in range(len(row)):
            rest[j] -= step[i] * row[j]
    for i in range(n - 1, -1, -1):
        total = step[i]
        row, rest = factor[i, i + 1 : min(n, i + band)], step[i + 1 : min(n, i + band)]
        for j in range(len(row)):
            total -= row[j] * rest[j]
        step[i] = total / factor[i, i]
    return True


@reassociating_inlined
def _hold(t: RobotArrays, control: Floats, pinned: int, gradient: Floats, held: Integers, step: Floats) -> None:
    """List the unknowns that the gradient would push beyond their limits, and start a step with -gradient."""
    dof = control.shape[1]
    for i in range(len(step)):
        d = i % dof
        value, g = control[pinned + i // dof, d], gradient[i]
        held[i] = (value <= t.lower[d] and g > 0.0) or (value >= t.upper[d] and g < 0.0)
        step[i] = -g


@reassociating_inlined
def _add_step(t: RobotArrays, control: Floats, pinned: int, step: Floats, trial: Floats) -> None:
    """Put the control points after a step, clipped to the limits, into ``trial``."""
    dof = control.shape[1]
    for i in range(len(step)):
        a, d = pinned + i // dof, i % dof
        trial[a, d] = min(max(control[a, d] + step[i], t.lower[d]), t.upper[d])


@reassociating_inlined
def descend(
    evaluate: Evaluate, problem: Problem, t: RobotArrays, s: SceneArrays, w: Workspace, speed_gram: Floats, pinned: int,
    control: Floats, settings: CostSettings, b: Buffers, width: int,
) -> tuple[PathCost, int, float]:  # fmt: skip
    """Take the steps on control points (P, dof), in place; return the cost, the number of steps, and the damping.

    Args:
        evaluate: Compiled function ``(problem, t, s, w, pinned, control, settings, b, gradient, gram)`` that returns
            the cost of control points, and puts gradient and matrix into place.
        problem: Its data.
        t: The robot.
        s: The scene.
        w: Workspace.
        speed_gram: Matrix A of the damping, shape (P, P).
        pinned: Number of control points at each end that stay.
        control: Control points.
        settings: Settings.
        b: Buffers.
        width: Number of neighboring control points that a sample depends on.
    """
    points, dof = control.shape
    n = (points - 2 * pinned) * dof
    for i in range(points):
        for d in range(dof):
            if pinned <= i < points - pinned:
                control[i, d] = min(max(control[i, d], t.lower[d]), t.upper[d])
            b.trial[i, d] = control[i, d]
    now, taken, damping, band = 0, 0, settings.damping, min(n, width * dof)
    cost = evaluate(problem, t, s, w, pinned, control, settings, b, b.gradient[now], b.gram[now])
    while taken < settings.steps and math.isfinite(cost.cost):
        if cost.scene_clearance >= settings.enough and cost.own_clearance >= settings.enough:
            break
        taken += 1
        new = cost
        _hold(t, control, pinned, b.gradient[now], b.held, b.step)
        better = _newton_step(
            b.gram[now], speed_gram, damping, pinned, dof, b.held, band, b.factor, b.panel, b.step
        )  # fmt: skip
        if better:
            _add_step(t, control, pinned, b.step, b.trial)
            new = evaluate(problem, t, s, w, pinned, b.trial, settings, b, b.gradient[1 - now], b.gram[1 - now])
            better = new.cost < cost.cost
        if not better:
            damping = max(4.0 * damping, LEAST_DAMPING)
            if damping > MOST_DAMPING:
                break
            continue
        gain = cost.cost - new.cost
        cost, now = new, 1 - now
        damping = max(damping / 3.0, LEAST_DAMPING)
        for i in range(points):
            for d in range(dof):
                control[i, d] = b.trial[i, d]
        if gain < settings.tolerance * cost.cost:
            break
    return cost, taken, damping


@reassociating_entry_point
def optimize_path(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, wi: Integers, wf: Floats,
    weights: Floats, first: Integers,
    speed_gram: Floats, pinned: int, control: Floats, numbers: Numbers, bi: Integers, bf: Floats,
) -> Report:  # fmt: skip
    """Improve a path in place; its control points (P, dof) are put inside the limits.

    Args:
        ri: Robot, packed; see :func:`apex_ompl.kernel.compiled.layout.pack`.
        rf: Robot.
        si: Scene, packed.
        sf: Scene.
        sg: Scene.
        wi: Workspace, see :func:`apex_ompl.kernel.compiled.workspace.workspace_sizes`.
        wf: Workspace.
        weights: Weights of control points at the samples, shape (N, degree + 1).
        first: The first control point that they belong to, shape (N,).
        speed_gram: Gram matrix A of the speed, shape (P, P).
        pinned: Number of control points at each end that stay.
        control: Control points.
        numbers: The fields of :class:`apex_ompl.kernel.compiled.path.path_cost.CostSettings`.
        bi: Buffers, see :func:`apex_ompl.kernel.compiled.path.path_cost.optimization_buffer_sizes`.
        bf: Buffers.

    Returns:
        The fields of :class:`apex_ompl.kernel.compiled.path.path_cost.PathReport`.
    """
    t, s = robot_view(ri, rf), scene_view(si, sf, sg)
    w = workspace_view(t, wi, wf)
    points, dof = control.shape
    b = buffers_view(bi, bf, ((points - 2 * pinned) * dof, points, dof))
    c, taken, damping = descend(
        evaluate_path, PathProblem(weights, first, speed_gram), t, s, w, speed_gram, pinned, control,
        CostSettings(*numbers), b, weights.shape[1],
    )  # fmt: skip
    return c.cost, c.clearance_cost, c.scene_clearance, c.own_clearance, taken, damping
