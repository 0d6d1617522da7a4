"""Distance of a body to another or to an obstacle, now and at least during a motion, by their exact shapes."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, HALF_SPACE, SPHERE
from apex_ompl.kernel.compiled.check.relative_motion import (
    Frames,
    convex_bound,
    half_space_distance,
    place_shape,
    set_relative_motion,
)
from apex_ompl.kernel.compiled.compilation import inlined, outlined
from apex_ompl.kernel.compiled.geometry.convex_distance import convex_distance
from apex_ompl.kernel.compiled.geometry.shapes import (
    HULL,
    MOST_NODES,
    POINT,
    TRIANGLE,
    PairBuffers,
    ShapeArrays,
    corners_of,
)
from apex_ompl.kernel.compiled.geometry.triangles import squared_distance
from apex_ompl.kernel.compiled.layout import Floats

MOST_LEAVES = 16  # pairs of triangles whose motion is examined
FAR, FAST = 0.005, 2.0  # distance [m], and displacement relative to it, from which a motion is to be halved at once


@inlined
def set_guess(h: ShapeArrays, g: PairBuffers, m: int, n: int) -> None:
    """Set the first direction: from ball to ball, of nodes or, for -1, of whole shapes."""
    for i in range(3):
        a, b = g.ball[0, i], g.ball[1, i]
        if m >= 0:
            r, c = g.rotation[0], h.node_ball[m]
            a = g.origin[0, i] + r[i, 0] * c[0] + r[i, 1] * c[1] + r[i, 2] * c[2]
        if n >= 0:
            r, c = g.rotation[1], h.node_ball[n]
            b = g.origin[1, i] + r[i, 0] * c[0] + r[i, 1] * c[1] + r[i, 2] * c[2]
        g.normal[i] = b - a
    if not g.normal[0] ** 2 + g.normal[1] ** 2 + g.normal[2] ** 2 > 0.0:
        g.normal[0] = 1.0


@inlined
def set_node(h: ShapeArrays, g: PairBuffers, s: int, node: int) -> None:
    """Set the piece of side ``s``: a triangle or a point for a leaf, else the node's ball on side 0, its box on 1."""
    r, o, b = g.rotation[s], g.origin[s], h.node_ball[node]
    if h.child[node] < 0:
        corner = h.corner[node]
        g.kind[s], g.first[s], g.corners[s], g.graph[s] = HULL, corner, TRIANGLE, -1
        if corner <= POINT:
            g.first[s], g.corners[s] = POINT - corner, 1
        for i in range(3):
            g.center[s, i] = o[i]
    else:
        g.kind[s], g.size[s, 0] = SPHERE, b[3]
        if s == 1:
            g.kind[s] = BOX
            for i in range(3):
                g.size[s, i] = h.node_half[node, i]
        for i in range(3):
            g.center[s, i] = o[i] + r[i, 0] * b[0] + r[i, 1] * b[1] + r[i, 2] * b[2]


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


@inlined
def _in_frame(r: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector of the world in the frame of a rotation."""
    return (
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
    )


@outlined
def nodes_apart(h: ShapeArrays, g: PairBuffers, m: int, n: int) -> float:
    """Return a lower bound of the distance of two nodes, -1 for a side that is a single piece [m].

    It is that of their balls, or of the ball of the first from the box of the second.
    """
    c, r, o = g.ball[0], g.rotation[0], g.origin[0]
    x, y, z, radius = c[0], c[1], c[2], c[3]
    if m >= 0:
        c = h.node_ball[m]
        x = o[0] + r[0, 0] * c[0] + r[0, 1] * c[1] + r[0, 2] * c[2]
        y = o[1] + r[1, 0] * c[0] + r[1, 1] * c[1] + r[1, 2] * c[2]
        z = o[2] + r[2, 0] * c[0] + r[2, 1] * c[1] + r[2, 2] * c[2]
        radius = c[3]
    if n < 0:
        c = g.ball[1]
        return float(math.sqrt((x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2) - radius - c[3])
    o, c, half = g.origin[1], h.node_ball[n], h.node_half[n]
    x, y, z = _in_frame(g.rotation[1], x - o[0], y - o[1], z - o[2])
    x, y, z = abs(x - c[0]), abs(y - c[1]), abs(z - c[2])
    from_ball = math.sqrt(x * x + y * y + z * z) - c[3]
    x, y, z = max(x - half[0], 0.0), max(y - half[1], 0.0), max(z - half[2], 0.0)
    return float(max(from_ball, math.sqrt(x * x + y * y + z * z)) - radius)


@outlined
def _ball_and_box_bound(h: ShapeArrays, g: PairBuffers) -> float:
    """Return a lower bound of the distance of a ball on side 0 from a box on side 1 during the motion [m]."""
    r, a, b, half = g.rotation[1], g.center[0], g.center[1], g.size[1]
    x, y, z = _in_frame(r, b[0] - a[0], b[1] - a[1], b[2] - a[2])
    x = math.copysign(max(abs(x) - half[0], 0.0), x)
    y = math.copysign(max(abs(y) - half[1], 0.0), y)
    z = math.copysign(max(abs(z) - half[2], 0.0), z)
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        return -math.inf
    for i in range(3):
        g.normal[i] = (r[i, 0] * x + r[i, 1] * y + r[i, 2] * z) / length
    return float(convex_bound(corners_of(h), g, length - g.size[0, 0]))


@inlined
def _inner_bound(
    h: ShapeArrays, g: PairBuffers, m: int, n: int, apart: float, arc: float, limit: float, first_order: bool
) -> float:
    """Return a lower bound of the distance of two nodes during the motion, of which one is a leaf or none is [m].

    Args:
        h: The shapes.
        g: The pair, whose pieces are those of the nodes.
        m: Node of side 0, -1 for a convex shape.
        n: Node of side 1, -1 for a convex shape.
        apart: Lower bound of the distance of the nodes now less ``arc`` [m].
        arc: Bound on the displacement of either side [m].
        limit: Lower bound that suffices [m].
        first_order: Whether a bound of first order is sought.
    """
    if m >= 0 and n >= 0 and h.child[m] >= 0 and h.child[n] >= 0:
        return max(apart, _ball_and_box_bound(h, g)) if first_order else apart
    if g.corners[1] == 1 and g.kind[1] == HULL:  # a ball from a point is exact
        return apart
    set_guess(h, g, m, n)
    distance = convex_distance(corners_of(h), g, limit + arc)[0]
    if first_order and distance > 0.0 and distance - arc < limit:
        return float(convex_bound(corners_of(h), g, distance))
    return float(distance - arc)


@inlined
def _leaves_bound(
    h: ShapeArrays, g: PairBuffers, m: int, n: int, arc: float, limit: float, first_order: bool
) -> tuple[float, float]:
    """Return bounds on the distance of two leaves, see :func:`_mesh_bound`; an infinite one now where it is far."""
    if not first_order and m >= 0 and n >= 0 and h.corner[n] <= POINT:
        distance = _point_to_triangle(h, g, h.corner[m], POINT - h.corner[n])
        return distance - arc, distance
    set_guess(h, g, m, n)
    distance, upper = convex_distance(corners_of(h), g, limit + arc)
    if distance - arc >= limit:
        return distance - arc, math.inf
    return (convex_bound(corners_of(h), g, distance) if first_order else distance - arc), upper


@outlined
def _mesh_bound(
    h: ShapeArrays, g: PairBuffers, m: int, n: int, arc: float, need: float, first_order: bool
) -> tuple[float, float]:
    """Return bounds on the distance of shapes of which one or both are meshes, from nodes ``m`` and ``n`` on [m].

    Pairs of nodes that are apart by ``need`` plus ``arc``, or by more than another pair is, are left out.

    Args:
        h: The shapes.
        g: The pair.
        m: Node of side 0, -1 for a convex shape.
        n: Node of side 1, -1 for a convex shape.
        arc: Bound on the displacement of either side [m].
        need: Lower bound that suffices [m].
        first_order: Whether bounds during the motion are sought for triangles that are nearer; else the distance now
            less ``arc`` is the bound.

    Returns:
        A lower bound during the motion, and the least distance of two triangles found now; minus infinity where a
        bound during the motion is less than ``need``, or too many triangles are near.
    """
    bound, least, top, leaves = math.inf, math.inf, 1, 0
    g.nodes[0, 0], g.nodes[0, 1] = m, n
    while top > 0:
        top -= 1
        m, n = g.nodes[top, 0], g.nodes[top, 1]
        apart = nodes_apart(h, g, m, n) - arc
        if apart >= min(need, bound):
            bound = min(bound, apart)
            continue
        inner, other = m >= 0 and h.child[m] >= 0, n >= 0 and h.child[n] >= 0
        if m >= 0:
            set_node(h, g, 0, m)
        if n >= 0:
            set_node(h, g, 1, n)
        limit = min(need, bound)
        if not (inner or other):
            here, upper = _leaves_bound(h, g, m, n, arc, limit, first_order)
            bound, least, leaves = min(bound, here), min(least, upper), leaves + (1 if upper < math.inf else 0)
            if first_order and (here < need or leaves > MOST_LEAVES):
                return -math.inf, least
            continue
        here = _inner_bound(h, g, m, n, apart, arc, limit, first_order)
        if here >= limit:
            bound = min(bound, here)
            continue
        if top + 2 > MOST_NODES:
            return -math.inf, least
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
    set_guess(h, g, -1, -1)
    arc = min(g.arc_bound[0], g.arc_bound[1])
    bound = -math.inf
    if h.depth[b] < math.inf:  # the hull of points that are all over the scene is no help
        distance, upper = convex_distance(corners_of(h), g, need + arc)
        if distance - arc >= need:
            return distance - arc, math.inf
        bound = convex_bound(corners_of(h), g, distance)
        if h.root[a] < 0 and h.root[b] < 0:
            return bound, upper
        if bound >= need:
            return bound, math.inf
        below = h.depth[a] + h.depth[b]
        if bound + below < need <= distance + below:  # they move too far, meshes or hulls
            return bound, math.inf
    if h.root[b] >= 0:
        later, least = _mesh_bound(h, g, -1, h.root[b], arc, need, True)
        if later >= need:
            return later, math.inf
        if FAR < least < FAST * arc:
            return -math.inf, math.inf
        place_shape(f, h, b, g, 1)
    now, upper = _mesh_bound(h, g, h.root[a], h.root[b], arc, need, False)
    if now >= need or not 0.0 < arc < upper or h.root[a] < 0:
        return max(bound, now), upper
    place_shape(f, h, a, g, 0)  # as a convex piece, where it is one
    place_shape(f, h, b, g, 1)
    later, _ = _mesh_bound(h, g, h.root[a], h.root[b], arc, need, True)
    return max(bound, now, later), upper
