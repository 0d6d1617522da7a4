"""Rows of the constraints on a motion, put into matrix and right-hand side of an interior-point step.

See :mod:`apex_ompl.kernel.compiled.timing.duration_optimization`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from apex_ompl.kernel.compiled.arrays import GRID, RobotArrays, SceneArrays
from apex_ompl.kernel.compiled.check.clearance import (
    gradient_between_bodies,
    gradient_to_obstacle,
    nearest_to_obstacle,
)
from apex_ompl.kernel.compiled.check.clearance_cost import nearest_of_pair
from apex_ompl.kernel.compiled.check.separation import tables_hold
from apex_ompl.kernel.compiled.compilation import reassociating_inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import next_obstacles
from apex_ompl.kernel.compiled.layout import Floats, Integers
from apex_ompl.kernel.compiled.path.path_cost import set_sample
from apex_ompl.kernel.compiled.robot.kinematics import place_robot
from apex_ompl.kernel.compiled.timing.duration_problem import (
    LEAST_BOUND_SLACK,
    LEAST_SLACK,
    ORDERS,
    UNIT,
    WIDTH,
    Buffers,
    DurationSettings,
    Penalize,
    Penalty,
    Problem,
    difference,
    differences,
)
from apex_ompl.kernel.compiled.workspace import Workspace

END_ROOM = 5e-4  # by which a motion may come nearer than its ends are [m]
END_REACH = 0.3  # distance from an end, of the joint that moves most, within which its margins are lower [rad]


@reassociating_inlined
def list_clearances(
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
def add_limits(
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
                x = scale * differences(order, i, d, control)
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
                    e = difference(order, m)
                    b.gradient[a * dof + d] += e * h
                    b.border[a * dof + d] += e * g
                    for n in range(m, min(order + 1, free + p.pinned - i)):
                        b.gram[a * dof + d, (n - m) * dof] += f * e * difference(order, n)
    return corner, slope


@reassociating_inlined
def add_bounds(t: RobotArrays, p: Problem, control: Floats, mu: float, b: Buffers) -> None:
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


@reassociating_inlined
def add_clearances(
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
        count = list_clearances(t, s, w, q, settings.horizon, count, b.clearance, b.row, b.key[now])
        b.begin[now, k + 1] = count
        if count == first and not penalty.always:
            continue
        near_start, near_goal = _nearness(q, control[0]), _nearness(q, control[points - 1])
        worst = min(worst, _set_rows(p, settings.margin, mu, now, k, near_start, near_goal, ends, b))
        _sum_rows(mu, now, k, b)
        penalize(penalty, t, w, q, b)
        _add_sample(p, k, free, dof, b)
    return worst * UNIT
