"""Lower bounds of the distance of two bodies over boxes of joint values, by their exact shapes.

Side 0 moves as seen from side 1. Joint i between them has the axis a_i through o_i at the middle of the box, and the
half width h_i. A point p that is within s of c moves, with arm_i = |a_i x (c - o_i)| + s + m, by at most

    m <- m + h_i arm_i  (revolute)   or   m + h_i  (prismatic),

from the tip to the root as in :mod:`apex_ompl.kernel.compiled.robot.motion_bound`. Along a unit vector n it moves by at
most

    sum_i h_i |n . a_i x (p - o_i)| + 1/2 sum_i arm_i h_i (h_i + 2 sum_k h_k),

k the joints between the root and i, by Taylor's theorem. The sum is convex in p, so that its largest value over a
convex piece follows from the piece's support function. A ball moves as its center does. Both bounds, from the distance
in the middle and from a separating plane there, hold over the whole box.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from apex_ompl.kernel.compiled.arrays import FIXED, REVOLUTE, SPHERE, RobotArrays, robot_view
from apex_ompl.kernel.compiled.check.pair_distance import nodes_apart, set_guess, set_node
from apex_ompl.kernel.compiled.check.relative_motion import Frames, place_shape, set_chain
from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.geometry.convex_distance import convex_distance, radius, support
from apex_ompl.kernel.compiled.geometry.shapes import (
    MOST_NODES,
    Corners,
    PairBuffers,
    ShapeArrays,
    corners_of,
    pair_view,
    shapes_view,
)
from apex_ompl.kernel.compiled.layout import Floats, Integers, buffer_view
from apex_ompl.kernel.compiled.robot.kinematics import place_joints, place_robot
from apex_ompl.kernel.compiled.workspace import Workspace, workspace_view

MOST_AXES = 32  # joints between two bodies that move


class BoxBuffers(NamedTuple):
    """The joints between two bodies, from side 0 to side 1.

    Attributes:
        number: How many there are, -1 for too many.
        turning: Whether a joint is revolute.
        axis: Axes in the world.
        place: Points on the axes [m].
        width: Half widths of the joints [rad], [m].
    """

    number: Annotated[Integers, 1]
    turning: Annotated[Integers, MOST_AXES]
    axis: Annotated[Floats, MOST_AXES, 3]
    place: Annotated[Floats, MOST_AXES, 3]
    width: Annotated[Floats, MOST_AXES]


_box_view = buffer_view(BoxBuffers, ())


@inlined
def _set_axes(f: Frames, g: PairBuffers, x: BoxBuffers, joint: int, other: int) -> None:
    """Set the joints between ``joint`` of side 0 and ``other`` of side 1 that move."""
    _, count = set_chain(f, g, joint, other)
    n = 0
    for i in range(count):
        j = g.chain[i]
        if f.joint_kind[j] == FIXED:
            continue
        width = abs(f.joint_ratio[j]) * f.half_width[f.joint_source[j]]
        if not width > 0.0:
            continue
        if n == MOST_AXES:
            n = -1
            break
        x.turning[n], x.width[n] = 1 if f.joint_kind[j] == REVOLUTE else 0, width
        for k in range(3):
            x.axis[n, k], x.place[n, k] = f.rotation[j, k, 2], f.origin[j, k]
        n += 1
    x.number[0] = n


@inlined
def _displacement(x: BoxBuffers, u: float, v: float, w: float, spread: float) -> tuple[float, float]:
    """Return bounds for the points within ``spread`` of (u, v, w): on the displacement, and on its second order [m]."""
    moved = levers = curvature = 0.0
    for i in range(x.number[0]):
        width, a = x.width[i], x.axis[i]
        if x.turning[i]:
            b, c, d = u - x.place[i, 0], v - x.place[i, 1], w - x.place[i, 2]
            b, c, d = a[1] * d - a[2] * c, a[2] * b - a[0] * d, a[0] * c - a[1] * b
            arm = math.sqrt(b * b + c * c + d * d) + spread + moved
            curvature += width * (levers + 0.5 * width * arm)
            levers += width * arm
            moved += width * arm
        else:
            levers += width
            moved += width
    return moved, curvature


@inlined
def _point_along(x: BoxBuffers, n: Floats, u: float, v: float, w: float) -> float:
    """Return how far a point moves along the vector ``n``, to first order [m]."""
    along = 0.0
    for i in range(x.number[0]):
        a = x.axis[i]
        b, c, d = a[0], a[1], a[2]
        if x.turning[i]:
            e, f, g = u - x.place[i, 0], v - x.place[i, 1], w - x.place[i, 2]
            b, c, d = a[1] * g - a[2] * f, a[2] * e - a[0] * g, a[0] * f - a[1] * e
        along += x.width[i] * abs(n[0] * b + n[1] * c + n[2] * d)
    return along


@outlined
def _piece_along(corners: Corners, g: PairBuffers, x: BoxBuffers, n: Floats) -> float:
    """Return how far the core of the piece of side 0 moves along the vector ``n``, to first order [m]."""
    along = 0.0
    for i in range(x.number[0]):
        a, o = x.axis[i], x.place[i]
        if not x.turning[i]:
            along += x.width[i] * abs(n[0] * a[0] + n[1] * a[1] + n[2] * a[2])
            continue
        b, c, d = n[1] * a[2] - n[2] * a[1], n[2] * a[0] - n[0] * a[2], n[0] * a[1] - n[1] * a[0]
        p = support(corners, g, 0, b, c, d)
        most = b * (p[0] - o[0]) + c * (p[1] - o[1]) + d * (p[2] - o[2])
        p = support(corners, g, 0, -b, -c, -d)
        least = b * (p[0] - o[0]) + c * (p[1] - o[1]) + d * (p[2] - o[2])
        along += x.width[i] * max(abs(most), abs(least))
    return along


@outlined
def _pieces_bound(h: ShapeArrays, g: PairBuffers, x: BoxBuffers, m: int, n: int, need: float) -> float:
    """Return a lower bound of the distance of two convex pieces over a box [m]."""
    corners, u, v, w, spread = corners_of(h), g.center[0, 0], g.center[0, 1], g.center[0, 2], 0.0
    if g.kind[0] != SPHERE:
        u, v, w, spread = g.ball[0, 0], g.ball[0, 1], g.ball[0, 2], g.ball[0, 3]
        if m >= 0:
            r, c = g.rotation[0], h.node_ball[m]
            u = g.origin[0, 0] + r[0, 0] * c[0] + r[0, 1] * c[1] + r[0, 2] * c[2]
            v = g.origin[0, 1] + r[1, 0] * c[0] + r[1, 1] * c[1] + r[1, 2] * c[2]
            w = g.origin[0, 2] + r[2, 0] * c[0] + r[2, 1] * c[1] + r[2, 2] * c[2]
            spread = c[3]
    moved, curvature = _displacement(x, u, v, w, spread)
    set_guess(h, g, m, n)
    distance = convex_distance(corners, g, need + moved)[0]
    if not distance > 0.0 or distance - moved >= need:
        return float(distance - moved)
    a, b, c = g.normal[0], g.normal[1], g.normal[2]
    p, q = support(corners, g, 0, a, b, c), support(corners, g, 1, -a, -b, -c)
    gap = a * (q[0] - p[0]) + b * (q[1] - p[1]) + c * (q[2] - p[2]) - radius(g, 0) - radius(g, 1)
    return float(max(distance - moved, gap - _piece_along(corners, g, x, g.normal) - curvature))


@inlined
def _balls_bound(h: ShapeArrays, g: PairBuffers, x: BoxBuffers, m: int, n: int) -> float:
    """Return a lower bound of the distance of the balls around two nodes over a box, -1 for whole shapes [m]."""
    b = g.ball[0]
    u, v, w, inner = b[0], b[1], b[2], b[3]
    if m >= 0:
        b, r, o = h.node_ball[m], g.rotation[0], g.origin[0]
        u = o[0] + r[0, 0] * b[0] + r[0, 1] * b[1] + r[0, 2] * b[2]
        v = o[1] + r[1, 0] * b[0] + r[1, 1] * b[1] + r[1, 2] * b[2]
        w, inner = o[2] + r[2, 0] * b[0] + r[2, 1] * b[1] + r[2, 2] * b[2], b[3]
    moved, curvature = _displacement(x, u, v, w, 0.0)
    bound = nodes_apart(h, g, m, n) - moved
    c = g.ball[1]
    a, e, d, outer = c[0], c[1], c[2], c[3]
    if n >= 0:
        c, r, o = h.node_ball[n], g.rotation[1], g.origin[1]
        a = o[0] + r[0, 0] * c[0] + r[0, 1] * c[1] + r[0, 2] * c[2]
        e = o[1] + r[1, 0] * c[0] + r[1, 1] * c[1] + r[1, 2] * c[2]
        d, outer = o[2] + r[2, 0] * c[0] + r[2, 1] * c[1] + r[2, 2] * c[2], c[3]
    a, e, d = a - u, e - v, d - w
    long = math.sqrt(a * a + e * e + d * d)
    if not long - inner - outer > bound:
        return float(bound)
    g.normal[0], g.normal[1], g.normal[2] = a / long, e / long, d / long
    return float(max(bound, long - inner - outer - _point_along(x, g.normal, u, v, w) - curvature))


@outlined
def box_bound(
    f: Frames, h: ShapeArrays, g: PairBuffers, x: BoxBuffers, a: int, b: int, least: float, need: float, most: int
) -> float:
    """Return a lower bound of the distance of two shapes over the box of ``f`` around the state in its middle [m].

    Args:
        f: Frames of the state in the middle, and half widths of the box.
        h: The shapes.
        g: Memory.
        x: Memory.
        a: Shape of the moving side.
        b: Shape of the other side.
        least: The search ends where a bound is not larger than this [m].
        need: Lower bound that suffices [m].
        most: Pairs of convex pieces that are examined at most.
    """
    place_shape(f, h, a, g, 0)
    place_shape(f, h, b, g, 1)
    _set_axes(f, g, x, h.joint[a], h.joint[b])
    if x.number[0] < 0:
        return -math.inf
    bound, top, leaves = math.inf, 1, 0
    g.nodes[0, 0], g.nodes[0, 1] = h.root[a], h.root[b]
    while top > 0:
        top -= 1
        m, n = g.nodes[top, 0], g.nodes[top, 1]
        limit = min(need, bound)
        here = _balls_bound(h, g, x, m, n)
        if here >= limit:
            bound = min(bound, here)
            continue
        inner, other = m >= 0 and h.child[m] >= 0, n >= 0 and h.child[n] >= 0
        if not (inner and other):
            if m >= 0:
                set_node(h, g, 0, m)
            if n >= 0:
                set_node(h, g, 1, n)
            here = max(here, _pieces_bound(h, g, x, m, n, limit))
            leaves += 1
            if here >= limit or not (inner or other):
                bound = min(bound, here)
                if here <= least or leaves > most:
                    return -math.inf
                continue
        if top + 2 > MOST_NODES:
            return -math.inf
        if inner and (not other or h.node_ball[m, 3] >= h.node_ball[n, 3]):
            first = h.child[m]
            swap = nodes_apart(h, g, first, n) < nodes_apart(h, g, first + 1, n)
            g.nodes[top, 0], g.nodes[top + 1, 0] = (first + 1, first) if swap else (first, first + 1)
            g.nodes[top, 1] = g.nodes[top + 1, 1] = n
        else:
            first = h.child[n]
            swap = nodes_apart(h, g, m, first) < nodes_apart(h, g, m, first + 1)
            g.nodes[top, 1], g.nodes[top + 1, 1] = (first + 1, first) if swap else (first, first + 1)
            g.nodes[top, 0] = g.nodes[top + 1, 0] = m
        top += 2  # the nearer one is examined first
    return float(bound)


@inlined
def _place(t: RobotArrays, w: Workspace, q: Floats) -> None:
    """Place all joints."""
    place_robot(t, w, q)
    place_joints(t, w, q, t.lazy, 0, len(t.lazy))


@entry_point
def box_bounds(
    ri: Integers, rf: Floats, hi: Integers, hf: Floats, wi: Integers, wf: Floats, gi: Integers, gf: Floats,
    xi: Integers, xf: Floats, a: int, b: int, middles: Floats, half: Floats, least: float, need: float, most: int,
    bounds: Floats,
) -> None:  # fmt: skip
    """Put lower bounds of the distance of two bodies over boxes of states into ``bounds`` (N,) [m].

    Robot and shapes come packed, then the buffers of a state, a pair and a box. Body ``a`` moves as seen from body
    ``b``. The boxes have their middles in ``middles``, shape (N, dof), and all the same half widths, shape (dof,).
    Bounds that are not larger than ``least`` may be minus infinity, as may those for which more than ``most`` pairs of
    pieces would be examined; those above ``need`` may be smaller, but not below it.
    """
    t, h = robot_view(ri, rf), shapes_view(hi, hf)
    w, g, x = workspace_view(t, wi, wf), pair_view(gi, gf, ()), _box_view(xi, xf, ())
    for i in range(len(half)):
        w.half_width[i] = half[i]
    f = Frames(
        t.joint_parent, t.joint_kind, t.joint_source, t.joint_ratio, w.rotation, w.origin, w.step, w.deviation,
        w.half_width,
    )  # fmt: skip
    for k in range(len(middles)):
        _place(t, w, middles[k])
        bounds[k] = box_bound(f, h, g, x, a, b, least, need, most)
