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
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

from apex_ompl.kernel.compiled.arrays import GRID, RobotArrays, SceneArrays, robot_view, scene_view
from apex_ompl.kernel.compiled.check.clearance import (
    gradient_between_bodies,
    gradient_to_obstacle,
    nearest_to_obstacle,
)
from apex_ompl.kernel.compiled.check.clearance_cost import nearest_of_pair
from apex_ompl.kernel.compiled.check.separation import tables_hold
from apex_ompl.kernel.compiled.compilation import reassociating_entry_point, reassociating_inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import next_obstacles
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles, buffer_sizes, buffer_view
from apex_ompl.kernel.compiled.path.path_cost import set_sample
from apex_ompl.kernel.compiled.robot.kinematics import place_robot
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

ORDERS = 3  # of derivatives that have limits
WIDTH = ORDERS + 1  # control points that a sample, or a jerk, depends on
UNIT = 0.01  # of clearances [m]
LEAST_SLACK = 0.02  # of a clearance that is new and too low [UNIT]
LEAST_BOUND_SLACK = 1e-6  # of a position limit [rad]
END_ROOM = 5e-4  # by which a motion may come nearer than its ends are [m]
END_REACH = 0.3  # distance from an end, of the joint that moves most, within which its margins are lower [rad]
LEAST_MEAN = 1e-8  # of slacks times multipliers
TO_BOUNDARY = 0.995  # share of the way to the boundary that a step takes at most
ROWS_PER_SAMPLE = 40  # clearances of a motion, on average at most
MOST_ENDS = 256  # clearances at start and goal


class DurationSettings(NamedTuple):
    """Settings of the steps.

    Attributes:
        margin: Least clearance [m].
        horizon: Clearances above it are left out [m].
        prox: Weight of half the squared change of a sample in a step [1/rad^2].
        mean: Mean of slacks times multipliers at the start.
        decrease: Share of that mean which a step aims at.
        largest: Largest change of a control point in a step [rad].
        tolerance: Sum of slacks times multipliers at which the steps end: a bound on what is left of the objective.
        hurry: Weight of u; 0 keeps the knot spacing.
        calm: Weight of half the sum of squared jerks as shares of their limits.
        steps: Most steps.
    """

    margin: float
    horizon: float
    prox: float
    mean: float
    decrease: float
    largest: float
    tolerance: float
    hurry: float
    calm: float
    steps: int


Penalty = Any
Penalize = Callable[..., None]
"""Compiled function ``(penalty, t, w, q, b)`` that adds further terms of the objective at a sample q.

Their negative gradient is added to ``b.sample_gradient``, the lower half of their matrix to ``b.sample_gram``.
"""

Numbers = tuple[float, float, float, float, float, float, float, float, float, int]  # of DurationSettings


class Buffers(NamedTuple):
    """Memory of the steps; unknown i * dof + d is joint d of free control point i.

    Attributes:
        gram: Band of the matrix from its diagonal on, a row for each unknown; then its Cholesky factor.
        gradient: Negative right-hand side, then the step.
        border: Column of u, then the solution for it.
        upper_dual: Multipliers of the limits of positive differences.
        lower_dual: Multipliers of the limits of negative differences.
        bound_dual: Multipliers of the upper and the lower position limits.
        clearance: Clearances over their margins, in UNIT.
        row: Their gradients, divided by UNIT.
        slack: Their slacks, of this step and the one before.
        dual: Their multipliers, of this step and the one before.
        key: What they are between, of this step and the one before.
        begin: The first one of each sample, of this step and the one before.
        end_clearance: Clearances at start and goal [m].
        end_key: What they are between.
        state: A sample, or its change.
        sample_gradient: Gradient of a sample.
        sample_gram: Matrix of a sample.
    """

    gram: Annotated[Floats, "unknowns", "band"]
    gradient: Annotated[Floats, "unknowns"]
    border: Annotated[Floats, "unknowns"]
    upper_dual: Annotated[Floats, ORDERS, "points", "dof"]
    lower_dual: Annotated[Floats, ORDERS, "points", "dof"]
    bound_dual: Annotated[Floats, 2, "unknowns"]
    clearance: Annotated[Floats, "rows"]
    row: Annotated[Floats, "rows", "dof"]
    slack: Annotated[Floats, 2, "rows"]
    dual: Annotated[Floats, 2, "rows"]
    key: Annotated[Integers, 2, "rows"]
    begin: Annotated[Integers, 2, "places"]
    end_clearance: Annotated[Floats, MOST_ENDS]
    end_key: Annotated[Integers, MOST_ENDS]
    state: Annotated[Floats, "dof"]
    sample_gradient: Annotated[Floats, "dof"]
    sample_gram: Annotated[Floats, "dof", "dof"]


buffers_view = buffer_view(Buffers, ("unknowns", "band", "points", "dof", "rows", "places"))


def duration_dimensions(points: int, pinned: int, dof: int, samples: int) -> dict[str, int]:
    """Return the dimensions of the buffers."""
    return {
        "unknowns": (points - 2 * pinned) * dof, "band": WIDTH * dof, "points": points, "dof": dof,
        "rows": ROWS_PER_SAMPLE * samples, "places": samples + 1,
    }  # fmt: skip


def duration_buffer_sizes(points: int, pinned: int, dof: int, samples: int) -> tuple[int, int]:
    """Return how many integers and floats one call needs as buffers."""
    return buffer_sizes(Buffers, **duration_dimensions(points, pinned, dof, samples))


class Problem(NamedTuple):
    """Data of a motion besides robot and scene.

    Attributes:
        weights: Weights of control points at the samples, shape (N, 4).
        first: The first control point that they belong to, shape (N,).
        mass: Band of the mass matrix of the samples, shape (P, 4).
        limits: Limits of velocity, acceleration and jerk, (3, dof); not positive for a joint that stays.
        pinned: Number of control points at each end that stay.
    """

    weights: Floats
    first: Integers
    mass: Floats
    limits: Floats
    pinned: int


@reassociating_inlined
def _difference(order: int, m: int) -> float:
    """Return the coefficient of control point ``m`` in a difference of an order from 1 to 3."""
    if order == 1:
        return -1.0 if m == 0 else 1.0
    if order == 2:
        return -2.0 if m == 1 else 1.0
    return (-1.0 if m == 0 else 1.0) if m % 3 == 0 else (3.0 if m == 1 else -3.0)


@reassociating_inlined
def _differences(order: int, i: int, d: int, values: Floats) -> float:
    """Return the ``i``-th difference of column ``d``."""
    if order == 1:
        return float(values[i + 1, d] - values[i, d])
    if order == 2:
        return float(values[i + 2, d] - 2.0 * values[i + 1, d] + values[i, d])
    return float(values[i + 3, d] - values[i, d] + 3.0 * (values[i + 1, d] - values[i + 2, d]))


@reassociating_inlined
def _step_difference(order: int, i: int, d: int, pinned: int, free: int, dof: int, step: Floats) -> float:
    """Return the ``i``-th difference of a step in joint ``d``; pinned points do not move."""
    total = 0.0
    for m in range(order + 1):
        a = i + m - pinned
        if 0 <= a < free:
            total += _difference(order, m) * step[a * dof + d]
    return total


@reassociating_inlined
def _clearances(
    t: RobotArrays, s: SceneArrays, w: Workspace, q: Floats, horizon: float, start: int, value: Floats, row: Floats,
    key: Integers,
) -> int:  # fmt: skip
    """List all clearances of a state below ``horizon`` from place ``start`` on; return the place after them.

    ``row`` gets their gradients, (rows, dof), or is of shape (0, dof). What does not fit in is left out.
    """
    place_robot(t, w, q)
    count, obstacles = start, len(s.kind)
    for c in range(len(t.cluster_joint)):
        if not t.cluster_meets_scene[c]:
            continue
        x, y, z = w.ball[c, 0], w.ball[c, 1], w.ball[c, 2]
        radius = t.cluster_outer[c] + horizon
        n = 0
        while True:
            n, first, end = next_obstacles(s, x, y, z, radius, n)
            if first == end:
                break
            for o in range(first, end):
                lowered = s.size[o, 1] if s.kind[o] == GRID else 0.0
                near = nearest_to_obstacle(t, s, w, q, c, o, (horizon - lowered, -1, -1, -1, -1))
                if near[1] < 0 or count >= len(value):
                    continue
                value[count], key[count] = near[0] + lowered, c * obstacles + o
                if len(row):
                    for i in range(len(q)):
                        row[count, i] = 0.0
                    gradient_to_obstacle(t, s, w, near, row[count])
                count += 1
    for p in range(len(t.pair_common)):
        near = nearest_of_pair(t, w, q, p, horizon)
        if near[1] < 0 or count >= len(value):
            continue
        value[count], key[count] = near[0], -1 - p
        if len(row):
            for i in range(len(q)):
                row[count, i] = 0.0
            gradient_between_bodies(t, w, near, row[count])
        count += 1
    return count


@reassociating_inlined
def _place_of(key: int, keys: Integers, first: int, last: int) -> int:
    """Return the place of a key from ``first`` to ``last``, or -1."""
    for k in range(first, last):
        if keys[k] == key:
            return k
    return -1


@reassociating_inlined
def _add_limits(
    p: Problem, control: Floats, u: float, mu: float, settings: DurationSettings, b: Buffers
) -> tuple[float, float]:
    """Add limits and objective to matrix and right-hand side; return the diagonal element of u and its gradient."""
    points, dof = control.shape
    free, corner, slope = points - 2 * p.pinned, 0.0, settings.hurry
    for order in range(1, ORDERS + 1):
        power, calm = math.exp(-order * u), settings.calm if order == ORDERS else 0.0
        for d in range(dof):
            if not p.limits[order - 1, d] > 0.0:
                continue
            scale = power / p.limits[order - 1, d]
            for i in range(points - order):
                x = scale * _differences(order, i, d, control)
                upper, lower = 1.0 / (1.0 - x), 1.0 / (1.0 + x)
                v, w = b.upper_dual[order - 1, i, d] * upper, b.lower_dual[order - 1, i, d] * lower
                corner += order * order * (v + w)
                slope -= order * mu * (upper + lower)
                f, g = scale * scale * (v + w + calm), order * scale * (w - v)
                h = scale * (mu * (upper - lower) + calm * x)
                for m in range(order + 1):
                    a = i + m - p.pinned
                    if a < 0 or a >= free:
                        continue
                    e = _difference(order, m)
                    b.gradient[a * dof + d] += e * h
                    b.border[a * dof + d] += e * g
                    for n in range(m, min(order + 1, free + p.pinned - i)):
                        b.gram[a * dof + d, (n - m) * dof] += f * e * _difference(order, n)
    return corner, slope


@reassociating_inlined
def _add_bounds(t: RobotArrays, p: Problem, control: Floats, mu: float, b: Buffers) -> None:
    """Add the position limits of the free control points; joints that stay get none, and no step."""
    dof = control.shape[1]
    for j in range(len(b.gradient)):
        d = j % dof
        if not p.limits[0, d] > 0.0:
            continue
        q = control[p.pinned + j // dof, d]
        upper = 1.0 / max(t.upper[d] - q, LEAST_BOUND_SLACK)
        lower = 1.0 / max(q - t.lower[d], LEAST_BOUND_SLACK)
        b.gram[j, 0] += b.bound_dual[0, j] * upper + b.bound_dual[1, j] * lower
        b.gradient[j] += mu * (upper - lower)


@reassociating_inlined
def _add_sample(p: Problem, k: int, free: int, dof: int, b: Buffers) -> None:
    """Add gradient and lower half of the matrix of sample ``k``, mapped to the control points."""
    for d in range(dof):
        for e in range(d):
            b.sample_gram[e, d] = b.sample_gram[d, e]
    for m in range(WIDTH):
        a, f = p.first[k] + m - p.pinned, p.weights[k, m]
        if a < 0 or a >= free:
            continue
        for d in range(dof):
            b.gradient[a * dof + d] -= f * b.sample_gradient[d]
            if not b.sample_gram[d, d] > 0.0:
                continue
            target, source = b.gram[a * dof + d], b.sample_gram[d]
            for e in range(d, dof):
                target[e - d] += f * f * source[e]
            for n in range(m + 1, WIDTH):
                if p.first[k] + n - p.pinned >= free:
                    break
                g, shift = f * p.weights[k, n], (n - m) * dof - d
                for e in range(dof):
                    target[shift + e] += g * source[e]


class Ends(NamedTuple):
    """Clearances at start and goal that are below the margin, of which those at the start come first.

    Attributes:
        starts: Number of those at the start.
        total: Number of all.
    """

    starts: int
    total: int


@reassociating_inlined
def _nearness(q: Floats, end: Floats) -> float:
    """Return 1 at an end of the motion, less in a state ``q`` farther from it, and 0 from ``END_REACH`` on."""
    distance = 0.0
    for d in range(len(q)):
        distance = max(distance, abs(q[d] - end[d]))
    return max(0.0, 1.0 - distance / END_REACH)


@reassociating_inlined
def _margin_of(key: int, margin: float, near_start: float, near_goal: float, ends: Ends, b: Buffers) -> float:
    """Return the margin of a clearance in a state near the ends as told [m]."""
    own, at = margin, _place_of(key, b.end_key, 0, ends.starts)
    if at >= 0:
        own = min(own, margin - near_start * (margin + END_ROOM - b.end_clearance[at]))
    at = _place_of(key, b.end_key, ends.starts, ends.total)
    if at >= 0:
        own = min(own, margin - near_goal * (margin + END_ROOM - b.end_clearance[at]))
    return own


@reassociating_inlined
def _set_rows(
    p: Problem, margin: float, mu: float, now: int, k: int, near_start: float, near_goal: float, ends: Ends, b: Buffers
) -> float:
    """Set the clearances of sample ``k`` over their margins, their slacks and multipliers; return the least [UNIT]."""
    before, worst = 1 - now, math.inf
    for r in range(b.begin[now, k], b.begin[now, k + 1]):
        own = _margin_of(b.key[now, r], margin, near_start, near_goal, ends, b)
        c = (b.clearance[r] - own) / UNIT
        worst = min(worst, c)
        slack = max(c, LEAST_SLACK)
        at = _place_of(b.key[now, r], b.key[before], b.begin[before, k], b.begin[before, k + 1])
        if at >= 0 and c <= 0.0:
            slack = max(slack, b.slack[before, at])
        b.clearance[r], b.slack[now, r] = c, slack
        b.dual[now, r] = b.dual[before, at] if at >= 0 else mu / slack
        for d in range(b.row.shape[1]):
            b.row[r, d] = b.row[r, d] / UNIT if p.limits[0, d] > 0.0 else 0.0
    return worst


@reassociating_inlined
def _sum_rows(mu: float, now: int, k: int, b: Buffers) -> None:
    """Put gradient and lower half of the matrix of the clearances of sample ``k`` into place."""
    dof = len(b.sample_gradient)
    for d in range(dof):
        b.sample_gradient[d] = 0.0
        for e in range(d + 1):
            b.sample_gram[d, e] = 0.0
    for r in range(b.begin[now, k], b.begin[now, k + 1]):
        row, slack = b.row[r], b.slack[now, r]
        f = b.dual[now, r] / slack
        g = mu / slack - f * (b.clearance[r] - slack)
        low, high = dof, -1  # joints that move it: those of one arm mostly
        for d in range(dof):
            if row[d] != 0.0:
                low, high = min(low, d), d
        for d in range(low, high + 1):
            e = f * row[d]
            b.sample_gradient[d] += g * row[d]
            target = b.sample_gram[d]
            for i in range(low, d + 1):
                target[i] += e * row[i]


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
def _add_clearances(
    t: RobotArrays, s: SceneArrays, w: Workspace, p: Problem, control: Floats, settings: DurationSettings, mu: float,
    now: int, ends: Ends, b: Buffers, penalize: Penalize, penalty: Penalty,
) -> float:  # fmt: skip
    """Add the clearances at all samples; return the least of them over its margin [m], minus infinity at a fault."""
    points, dof = control.shape
    free, count, worst = points - 2 * p.pinned, 0, math.inf
    q = b.state
    for k in range(len(p.weights)):
        set_sample(p.weights, p.first, k, control, t.lower, t.upper, q)
        if not tables_hold(t, q, w.half_width):
            return -math.inf
        b.begin[now, k] = first = count
        count = _clearances(t, s, w, q, settings.horizon, count, b.clearance, b.row, b.key[now])
        b.begin[now, k + 1] = count
        if count == first and not penalty.always:
            continue
        near_start, near_goal = _nearness(q, control[0]), _nearness(q, control[points - 1])
        worst = min(worst, _set_rows(p, settings.margin, mu, now, k, near_start, near_goal, ends, b))
        _sum_rows(mu, now, k, b)
        penalize(penalty, t, w, q, b)
        _add_sample(p, k, free, dof, b)
    return worst * UNIT


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
def _forward(factor: Floats, x: Floats) -> None:
    """Multiply by the inverse of the transpose of a factor of :func:`_factorize` in place."""
    n, band = factor.shape
    for k in range(n):
        x[k] /= factor[k, 0]
        f, most = x[k], min(band, n - k)
        row, rest = factor[k, 1:most], x[k + 1 : k + most]
        for j in range(len(rest)):
            rest[j] -= f * row[j]


@reassociating_inlined
def _backward(factor: Floats, x: Floats) -> None:
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
    _forward(b.gram, b.gradient)
    _forward(b.gram, b.border)
    product, square = 0.0, 0.0
    for j in range(len(b.gradient)):
        product += b.border[j] * b.gradient[j]
        square += b.border[j] * b.border[j]
    change = (-slope - product) / (corner - square) if hurry > 0.0 else 0.0
    for j in range(len(b.gradient)):
        b.gradient[j] -= change * b.border[j]
    _backward(b.gram, b.gradient)
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
                x = scale * _differences(order, i, d, control)
                change = scale * _step_difference(order, i, d, p.pinned, free, dof, step)
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
                x = scale * _differences(order, i, d, control)
                change = scale * _step_difference(order, i, d, p.pinned, free, dof, step)
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
                x = power / p.limits[order - 1, d] * _differences(order, i, d, control)
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
    starts = _clearances(t, s, w, control[0], settings.margin, 0, b.end_clearance, b.row[:0], b.end_key)
    count = _clearances(t, s, w, control[points - 1], settings.margin, starts, b.end_clearance, b.row[:0], b.end_key)
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
        corner, slope = _add_limits(p, control, u, mu, settings, b)
        _add_bounds(t, p, control, mu, b)
        worst = _add_clearances(t, s, w, p, control, settings, mu, now, ends, b, penalize, penalty)
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
