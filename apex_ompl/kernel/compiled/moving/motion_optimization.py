"""Levenberg-Marquardt steps on a motion among dynamic obstacles: the control points of a spline in time.

The cost is that of a path (:mod:`apex_ompl.kernel.compiled.path.path_cost`), with clearances to dynamic obstacles at
the times of the samples, and a term for exceeded limits. For the uniform cubic B-spline in time with knot spacing h,
whose k-th differences are D_k P,

    limits = weight / 2 sum_k sum_i sum_d max(0, |D_k P|_id / (limit_kd h^k) - 1)^2,   k = 1, 2, 3,

counts velocities, accelerations and jerks: those of a cubic spline are convex combinations of these numbers.

Joints may follow a given motion, as those of another arm do: at the samples they have its values, and their control
points stay.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance_cost import state_cost
from apex_ompl.kernel.compiled.check.separation import tables_hold
from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles
from apex_ompl.kernel.compiled.moving.dynamic_obstacles import DynamicArrays, dynamic_view, scene_of_dynamic
from apex_ompl.kernel.compiled.moving.state_costs import add_dynamic
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

ORDERS = 3  # of derivatives that have limits
WIDTH = ORDERS + 1  # control points that a sample, or a jerk, depends on


class MotionProblem(NamedTuple):
    """Data of the cost of a motion in addition to robot and scene.

    Attributes:
        weights: Weights of control points at the samples, shape (N, 4).
        first: The first control point that they belong to, shape (N,).
        speed_gram: Matrix of the speed term, shape (P, P).
        dynamic: The dynamic obstacles.
        placed: The dynamic obstacles as a scene, placed for one sample at a time.
        times: Times of the samples by the dynamic obstacles' clock, shape (N,) [s].
        limits: Limits of velocity, acceleration and jerk times the knot spacing, its square and its cube, (3, dof).
        limit_weight: Weight of what they are exceeded by.
        given: Values at the samples of joints that follow a given motion, NaN of all others, shape (N, dof); without
            such joints (0, dof).
    """

    weights: Floats
    first: Integers
    speed_gram: Floats
    dynamic: DynamicArrays
    placed: SceneArrays
    times: Floats
    limits: Floats
    limit_weight: float
    given: Floats


@inlined
def _set_given(given: Floats, k: int, q: Floats) -> None:
    """Put the values that joints are given at sample ``k`` into a state."""
    if k < len(given):
        for i in range(len(q)):
            if not math.isnan(given[k, i]):
                q[i] = given[k, i]


@inlined
def _clear_given(given: Floats, k: int, gradient: Floats, gram: Floats) -> None:
    """Put zeros into the gradient and the rows and columns of the matrix of joints that are given."""
    if k < len(given):
        for i in range(len(gradient)):
            if not math.isnan(given[k, i]):
                gradient[i] = 0.0
                for j in range(len(gradient)):
                    gram[i, j], gram[j, i] = 0.0, 0.0


@inlined
def _difference(order: int, m: int) -> float:
    """Return the coefficient of control point ``m`` in a difference of an order from 1 to 3."""
    if order == 1:
        return -1.0 if m == 0 else 1.0
    if order == 2:
        return -2.0 if m == 1 else 1.0
    return (-1.0 if m == 0 else 1.0) if m % 3 == 0 else (3.0 if m == 1 else -3.0)


@inlined
def _add_limits(limits: Floats, weight: float, pinned: int, control: Floats, gradient: Floats, gram: Floats) -> float:
    """Add gradient and matrix of what the limits are exceeded by; return the term."""
    points, dof = control.shape
    free, total = points - 2 * pinned, 0.0
    for order in range(1, ORDERS + 1):
        for i in range(points - order):
            for d in range(dof):
                value = 0.0
                for m in range(order + 1):
                    value += _difference(order, m) * control[i + m, d]
                excess = abs(value) / limits[order - 1, d] - 1.0
                if not excess > 0.0:
                    continue
                total += 0.5 * weight * excess * excess
                scale = math.copysign(1.0 / limits[order - 1, d], value)
                for m in range(order + 1):
                    a = i + m - pinned
                    if a < 0 or a >= free:
                        continue
                    f = weight * scale * _difference(order, m)
                    gradient[a * dof + d] += f * excess
                    for k in range(m, order + 1):
                        b = i + k - pinned
                        if b < free:
                            gram[a * dof + d, b * dof + d] += f * scale * _difference(order, k)
    return total


@inlined
def evaluate_motion(
    problem: MotionProblem, t: RobotArrays, s: SceneArrays, w: Workspace, pinned: int, control: Floats,
    settings: CostSettings, b: Buffers, gradient: Floats, gram: Floats,
) -> PathCost:  # fmt: skip
    """Return the cost of a motion; put its gradient (n,) and the upper band of its matrix (n, n) into place.

    The clearance to the scene is that to the dynamic obstacles, too.
    """
    weights, first, dof, dynamic = problem.weights, problem.first, control.shape[1], problem.dynamic
    free, margin = len(control) - 2 * pinned, settings.scene_margin
    clear(WIDTH * dof, gradient, gram)
    scene, own = margin, settings.own_margin
    total, share, q = 0.0, 1.0 / len(weights), b.state
    for k in range(len(weights)):
        set_sample(weights, first, k, control, t.lower, t.upper, q)
        _set_given(problem.given, k, q)
        if not tables_hold(t, q, w.half_width):
            return PathCost(math.inf, math.inf, -math.inf, -math.inf)
        cost, scene, own = state_cost(
            t, s, w, q, margin, settings.own_margin, b.row, b.state_gradient, b.state_gram, scene, own,
        )  # fmt: skip
        moving, scene = add_dynamic(
            t, dynamic, problem.placed, w, q, problem.times[k], margin, b.row, b.state_gradient, b.state_gram, scene
        )
        cost += moving
        if cost > 0.0:
            total += share * cost
            _clear_given(problem.given, k, b.state_gradient, b.state_gram)
            add_sample(
                share, weights[k], first[k], pinned, free, b.state_gradient, b.state_gram, gradient, gram, b.room
            )
    rest = add_speed(settings.stiffness, problem.speed_gram, pinned, control, gradient, gram)
    rest += _add_limits(problem.limits, problem.limit_weight, pinned, control, gradient, gram)
    return PathCost(total + rest, total, scene, own)


@entry_point
def optimize_motion(
    ri: Integers, rf: Floats, si: Integers, sf: Floats, sg: Singles, mi: Integers, mf: Floats, ms: Singles,
    wi: Integers, wf: Floats, offset: Floats,
    weights: Floats, first: Integers, speed_gram: Floats, times: Floats, limits: Floats, limit_weight: float,
    given: Floats, pinned: int, control: Floats, numbers: Numbers, bi: Integers, bf: Floats, slope: Floats,
) -> Report:  # fmt: skip
    """Improve a motion in place; its free control points (P, dof) are put inside the limits.

    Arguments are those of :func:`apex_ompl.kernel.compiled.path.path_optimization.optimize_path` and of
    :class:`MotionProblem`; ``mi``, ``mf`` and ``ms`` are packed dynamic obstacles, ``offset`` (M, 3) a buffer for their
    places. ``slope`` (n,) gets the gradient where no steps are asked for; shape (0,) asks for none.

    Returns:
        The fields of :class:`apex_ompl.kernel.compiled.path.path_cost.PathReport`.
    """
    t, s, m = robot_view(ri, rf), scene_view(si, sf, sg), dynamic_view(mi, mf, ms)
    w = workspace_view(t, wi, wf)
    points, dof = control.shape
    b = buffers_view(bi, bf, ((points - 2 * pinned) * dof, points, dof))
    problem = MotionProblem(
        weights, first, speed_gram, m, scene_of_dynamic(m, offset), times, limits, limit_weight, given
    )  # fmt: skip
    c, taken, damping = descend(
        evaluate_motion, problem, t, s, w, speed_gram, pinned, control, CostSettings(*numbers), b, WIDTH
    )
    for i in range(len(slope)):
        slope[i] = b.gradient[0, i]
    return c.cost, c.clearance_cost, c.scene_clearance, c.own_clearance, taken, damping
