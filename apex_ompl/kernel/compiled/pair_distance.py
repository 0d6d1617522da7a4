"""Distance of a body to another or to an obstacle, now and at least during a motion, by their exact shapes."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import HALF_SPACE, SPHERE
from apex_ompl.kernel.compiled.compilation import inlined, outlined
from apex_ompl.kernel.compiled.convex_distance import convex_distance
from apex_ompl.kernel.compiled.relative_motion import (
    Frames,
    convex_bound,
    half_space_distance,
    place_shape,
    set_relative_motion,
)
from apex_ompl.kernel.compiled.shapes import HULL, MOST_NODES, POINT, TRIANGLE, PairBuffers, ShapeArrays
from apex_ompl.kernel.compiled.triangle_distance import squared_distance

MOST_LEAVES = 64  # pairs of triangles whose motion is looked at


@inlined
def _set_guess(g: PairBuffers) -> None:
    """Set the direction to begin with: from ball to ball."""
    for i in range(3):
        g.normal[i] = g.ball[1, i] - g.ball[0, i]
    if not g.normal[0] ** 2 + g.normal[1] ** 2 + g.normal[2] ** 2 > 0.0:
        g.normal[0] = 1.0


@inlined
def _set_node(h: ShapeArrays, g: PairBuffers, s: int, node: int) -> None:
    """Set the piece of side ``s``: a triangle for a leaf, else the node's ball."""
    r, o, b = g.rotation[s], g.origin[s], h.node_ball[node]
    if h.child[node] < 0:
        corner = h.corner[node]
        g.kind[s], g.first[s], g.corners[s] = HULL, corner, TRIANGLE
        if corner <= POINT:
            g.first[s], g.corners[s] = POINT - corner, 1
        for i in range(3):
            g.centre[s, i] = o[i]
    else:
        g.kind[s], g.size[s, 0] = SPHERE, b[3]
        for i in range(3):
            g.centre[s, i] = o[i] + r[i, 0] * b[0] + r[i, 1] * b[1] + r[i, 2] * b[2]


@inlined
def _point_to_triangle(h: ShapeArrays, g: PairBuffers, first: int, point: int) -> float:
    """Return the distance of a point of side 1 from a triangle of side 0 [m]."""
    p, r, o, turn, there = h.points[point], g.rotation[1], g.origin[1], g.rotation[0], g.origin[0]
    x = o[0] + r[0, 0] * p[0] + r[0, 1] * p[1] + r[0, 2] * p[2] - there[0]
    y = o[1] + r[1, 0] * p[0] + r[1, 1] * p[1] + r[1, 2] * p[2] - there[1]
    z = o[2] + r[2, 0] * p[0] + r[2, 1] * p[1] + r[2, 2] * p[2] - there[2]
    squared = squared_distance(
        h.points[first], h.points[first + 1], h.points[first + 2],
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )  # fmt: skip
    return float(math.sqrt(squared))


@outlined
def _balls_apart(h: ShapeArrays, g: PairBuffers, m: int, n: int) -> float:
    """Return the distance of the balls of two nodes, -1 for a side that is a single piece [m]."""
    apart = 0.0
    for i in range(3):
        a, b = g.ball[0, i], g.ball[1, i]
        if m >= 0:
            r, c = g.rotation[0], h.node_ball[m]
            a = g.origin[0, i] + r[i, 0] * c[0] + r[i, 1] * c[1] + r[i, 2] * c[2]
        if n >= 0:
            r, c = g.rotation[1], h.node_ball[n]
            b = g.origin[1, i] + r[i, 0] * c[0] + r[i, 1] * c[1] + r[i, 2] * c[2]
        apart += (a - b) ** 2
    first = g.ball[0, 3] if m < 0 else h.node_ball[m, 3]
    second = g.ball[1, 3] if n < 0 else h.node_ball[n, 3]
    return float(math.sqrt(apart) - first - second)


@outlined
def _balls_bound(h: ShapeArrays, g: PairBuffers, distance: float) -> float:
    """Return a lower bound of the distance of two balls during the motion, given that of now [m]."""
    length = 0.0
    for i in range(3):
        g.normal[i] = g.centre[1, i] - g.centre[0, i]
        length += g.normal[i] ** 2
    if not length > 0.0:
        return -math.inf
    length = math.sqrt(length)
    for i in range(3):
        g.normal[i] /= length
    return float(convex_bound(h.points, g, distance))


@inlined
def _inner_bound(
    h: ShapeArrays, g: PairBuffers, both: bool, apart: float, arc: float, limit: float, first_order: bool
) -> float:
    """Return a lower bound of the distance of two nodes during the motion, of which one is a leaf or none is [m].

    Args:
        h: The shapes.
        g: The pair, whose pieces are those of the nodes.
        both: Whether none is a leaf.
        apart: Distance of the balls now less ``arc`` [m].
        arc: Bound on the displacement of either side [m].
        limit: Lower bound that suffices [m].
        first_order: Whether a bound of first order is sought for balls.
    """
    if both:
        return _balls_bound(h, g, apart + arc) if first_order else apart
    if g.corners[1] == 1 and g.kind[1] == HULL:  # a ball from a point is exact
        return apart
    _set_guess(g)
    return float(convex_distance(h.points, g, limit + arc)[0] - arc)


@inlined
def _leaves_bound(
    h: ShapeArrays, g: PairBuffers, m: int, n: int, arc: float, limit: float, first_order: bool
) -> tuple[float, float]:
    """Return bounds on the distance of two leaves, see :func:`_mesh_bound`; an infinite one now where it is far."""
    if not first_order and m >= 0 and n >= 0 and h.corner[n] <= POINT:
        distance = _point_to_triangle(h, g, h.corner[m], POINT - h.corner[n])
        return distance - arc, distance
    _set_guess(g)
    distance, upper = convex_distance(h.points, g, limit + arc)
    if distance - arc >= limit:
        return distance - arc, math.inf
    return (convex_bound(h.points, g, distance) if first_order else distance - arc), upper


@outlined
def _mesh_bound(
    h: ShapeArrays, g: PairBuffers, m: int, n: int, arc: float, need: float, first_order: bool
) -> tuple[float, float]:
    """Return bounds on the distance of shapes of which one or both are meshes, from nodes ``m`` and ``n`` on [m].

    Pairs of nodes whose balls are apart by ``need`` plus ``arc``, or by more than another pair is, are left out.

    Args:
        h: The shapes.
        g: The pair.
        m: Node of side 0, -1 for a convex shape.
        n: Node of side 1, likewise.
        arc: Bound on the displacement of either side [m].
        need: Lower bound that suffices [m].
        first_order: Whether bounds during the motion are sought for triangles that are nearer; else the distance now
            less ``arc`` is the bound.

    Returns:
        A lower bound during the motion, and the least distance of two triangles found now; minus infinity where too
        many triangles are near.
    """
    bound, least, top, leaves = math.inf, math.inf, 1, 0
    g.nodes[0, 0], g.nodes[0, 1] = m, n
    while top > 0:
        top -= 1
        m, n = g.nodes[top, 0], g.nodes[top, 1]
        apart = _balls_apart(h, g, m, n) - arc
        if apart >= min(need, bound):
            bound = min(bound, apart)
            continue
        inner, other = m >= 0 and h.child[m] >= 0, n >= 0 and h.child[n] >= 0
        if m >= 0:
            _set_node(h, g, 0, m)
        if n >= 0:
            _set_node(h, g, 1, n)
        limit = min(need, bound)
        if not (inner or other):
            here, upper = _leaves_bound(h, g, m, n, arc, limit, first_order)
            bound, least, leaves = min(bound, here), min(least, upper), leaves + (1 if upper < math.inf else 0)
            if leaves > MOST_LEAVES and first_order:
                return -math.inf, least
            continue
        here = _inner_bound(h, g, inner and other, apart, arc, limit, first_order)
        if here >= limit:
            bound = min(bound, here)
            continue
        if top + 2 > MOST_NODES:
            return -math.inf, least
        if inner and (not other or h.node_ball[m, 3] >= h.node_ball[n, 3]):
            first = h.child[m]
            swap = _balls_apart(h, g, first, n) < _balls_apart(h, g, first + 1, n)
            g.nodes[top, 0], g.nodes[top + 1, 0] = (first + 1, first) if swap else (first, first + 1)
            g.nodes[top, 1] = g.nodes[top + 1, 1] = n
        else:
            first = h.child[n]
            swap = _balls_apart(h, g, m, first) < _balls_apart(h, g, m, first + 1)
            g.nodes[top, 1], g.nodes[top + 1, 1] = (first + 1, first) if swap else (first, first + 1)
            g.nodes[top, 0] = g.nodes[top + 1, 0] = m
        top += 2  # the nearer one is looked at first
    return bound, least


@inlined
def pair_bound(f: Frames, h: ShapeArrays, a: int, b: int, g: PairBuffers, need: float) -> tuple[float, float]:
    """Return bounds on the distance of two shapes [m], the second of which may be balls around points.

    See :func:`_pair_bound`.
    """
    radius = h.size[b, 0] if h.kind[b] == HULL else 0.0
    bound, upper = _pair_bound(f, h, a, b, g, need + radius)
    return bound - radius, upper - radius


@outlined
def _pair_bound(f: Frames, h: ShapeArrays, a: int, b: int, g: PairBuffers, need: float) -> tuple[float, float]:
    """Return bounds on the distance of two shapes, points without their balls [m].

    Args:
        f: Frames of the state in the middle, and the motion.
        h: The shapes.
        a: Shape of the first side, a body.
        b: Shape of the second side, a body or an obstacle.
        g: Memory.
        need: Lower bound that suffices [m].

    Returns:
        A lower bound during the whole motion, and an upper bound now: the distance of two points of the shapes,
        infinite where it was not needed. Meshes have their surfaces alone.
    """
    place_shape(f, h, a, g, 0)
    i, j = h.joint[a], h.joint[b]
    set_relative_motion(f, g, 0, i, j)
    if h.kind[b] == HALF_SPACE:
        return half_space_distance(g, h, b)
    place_shape(f, h, b, g, 1)
    set_relative_motion(f, g, 1, j, i)
    _set_guess(g)
    arc = min(g.arc_bound[0], g.arc_bound[1])
    bound = -math.inf
    if h.depth[b] < math.inf:  # the hull of points that are all over the scene says nothing
        distance, upper = convex_distance(h.points, g, need + arc)
        if distance - arc >= need:
            return distance - arc, math.inf
        bound = convex_bound(h.points, g, distance)
        if h.root[a] < 0 and h.root[b] < 0:
            return bound, upper
        if bound >= need:
            return bound, math.inf
        below = h.depth[a] + h.depth[b]
        if bound + below < need <= distance + below:  # they move too far, meshes or hulls
            return bound, math.inf
    now, upper = _mesh_bound(h, g, h.root[a], h.root[b], arc, need, False)
    if now >= need or not 0.0 < arc < upper:
        return max(bound, now), upper
    place_shape(f, h, a, g, 0)  # as a convex piece, where it is one
    place_shape(f, h, b, g, 1)
    later, _ = _mesh_bound(h, g, h.root[a], h.root[b], arc, need, True)
    return max(bound, now, later), upper
