"""Convex pieces: their distance with certificates, and the farthest points of a cloud in given directions.

The distance is that of Gilbert, Johnson and Keerthi (1988). A piece is a core (point, segment, box, cylinder or hull of
points) with a radius around it. For the cores A and B the algorithm looks for the point v of B - A that is nearest to
the origin. Each direction d = v / |v| gives a lower bound of the distance, min d . (b - a) over all points of both,
which is that of a separating plane; each v is the difference of two points of the pieces, so that |v| is an upper
bound. Both hold whether or not the algorithm converges.
"""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, SPHERE
from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.geometry.shapes import Corners, PairBuffers
from apex_ompl.kernel.compiled.layout import Floats, Integers

MOST_STEPS = 100
TOLERANCE = 1e-7  # of distances [m]

Vector = tuple[float, float, float]


@inlined
def radius(g: PairBuffers, s: int) -> float:
    """Return the radius around the core of side ``s`` [m]."""
    return float(g.size[s, 0]) if g.kind[s] == SPHERE or g.kind[s] == CAPSULE else 0.0


@inlined
def _climb(corners: Corners, g: PairBuffers, s: int, x: float, y: float, z: float) -> int:
    """Return the corner of the hull on side ``s`` that is farthest along a direction in its frame.

    From the corner that was found last, over neighbors that are farther: where none is, no corner is.
    """
    points, first, graph, at = corners.points, g.first[s], g.graph[s], g.at[s]
    best = points[first + at, 0] * x + points[first + at, 1] * y + points[first + at, 2] * z
    before = -1
    while before != at:
        before = at
        for e in range(corners.edge_first[graph + before], corners.edge_first[graph + before + 1]):
            k = corners.edge_end[e]
            value = points[first + k, 0] * x + points[first + k, 1] * y + points[first + k, 2] * z
            if value > best:
                best, at = value, k
    g.at[s] = at
    return int(first + at)


@outlined
def support(corners: Corners, g: PairBuffers, s: int, x: float, y: float, z: float) -> Vector:
    """Return the point of the core of side ``s`` that is farthest along a direction, in the world [m]."""
    points = corners.points
    kind, o = g.kind[s], g.center[s]
    if kind == SPHERE:
        return o[0], o[1], o[2]
    r, size = g.rotation[s], g.size[s]
    a = r[0, 0] * x + r[1, 0] * y + r[2, 0] * z
    b = r[0, 1] * x + r[1, 1] * y + r[2, 1] * z
    c = r[0, 2] * x + r[1, 2] * y + r[2, 2] * z
    if kind == BOX:
        a, b, c = math.copysign(size[0], a), math.copysign(size[1], b), math.copysign(size[2], c)
    elif kind == CAPSULE:
        a, b, c = 0.0, 0.0, math.copysign(size[1], c)
    elif kind == CYLINDER:
        across = math.sqrt(a * a + b * b)
        a, b = (a / across * size[0], b / across * size[0]) if across > 0.0 else (0.0, 0.0)
        c = math.copysign(size[1], c)
    elif g.graph[s] >= 0:
        at = _climb(corners, g, s, a, b, c)
        a, b, c = points[at, 0], points[at, 1], points[at, 2]
    else:
        best, at = -math.inf, g.first[s]
        for k in range(g.first[s], g.first[s] + g.corners[s]):
            value = points[k, 0] * a + points[k, 1] * b + points[k, 2] * c
            if value > best:
                best, at = value, k
        a, b, c = points[at, 0], points[at, 1], points[at, 2]
    return (
        o[0] + r[0, 0] * a + r[0, 1] * b + r[0, 2] * c,
        o[1] + r[1, 0] * a + r[1, 1] * b + r[1, 2] * c,
        o[2] + r[2, 0] * a + r[2, 1] * b + r[2, 2] * c,
    )


@inlined
def _segment(p: Floats, i: int, j: int) -> tuple[float, float, float, int]:
    """Return the point of a segment that is nearest to the origin, and the corners that it needs as bits."""
    x, y, z = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    long = x * x + y * y + z * z
    along = -(p[i, 0] * x + p[i, 1] * y + p[i, 2] * z)
    if not along > 0.0:
        return p[i, 0], p[i, 1], p[i, 2], 1 << i
    if along >= long:
        return p[j, 0], p[j, 1], p[j, 2], 1 << j
    u = along / long
    return p[i, 0] + u * x, p[i, 1] + u * y, p[i, 2] + u * z, (1 << i) | (1 << j)


@outlined
def _triangle(p: Floats, i: int, j: int, k: int) -> tuple[float, float, float, int]:
    """Return the point of a triangle that is nearest to the origin, and the corners that it needs as bits.

    By Voronoi regions (Ericson, Real-Time Collision Detection, 5.1.5).
    """
    ux, uy, uz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    vx, vy, vz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    d1 = -(ux * p[i, 0] + uy * p[i, 1] + uz * p[i, 2])
    d2 = -(vx * p[i, 0] + vy * p[i, 1] + vz * p[i, 2])
    if d1 <= 0.0 and d2 <= 0.0:
        return p[i, 0], p[i, 1], p[i, 2], 1 << i
    d3 = -(ux * p[j, 0] + uy * p[j, 1] + uz * p[j, 2])
    d4 = -(vx * p[j, 0] + vy * p[j, 1] + vz * p[j, 2])
    if d3 >= 0.0 and d4 <= d3:
        return p[j, 0], p[j, 1], p[j, 2], 1 << j
    d5 = -(ux * p[k, 0] + uy * p[k, 1] + uz * p[k, 2])
    d6 = -(vx * p[k, 0] + vy * p[k, 1] + vz * p[k, 2])
    if d6 >= 0.0 and d5 <= d6:
        return p[k, 0], p[k, 1], p[k, 2], 1 << k
    c = d1 * d4 - d3 * d2
    if c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return _segment(p, i, j)
    b = d5 * d2 - d1 * d6
    if b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return _segment(p, i, k)
    a = d3 * d6 - d5 * d4
    if a <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        return _segment(p, j, k)
    total = a + b + c
    if not total > 0.0:
        return _segment(p, i, j)
    u, v = b / total, c / total
    bits = (1 << i) | (1 << j) | (1 << k)
    return p[i, 0] + ux * u + vx * v, p[i, 1] + uy * u + vy * v, p[i, 2] + uz * u + vz * v, bits


@inlined
def _outside(p: Floats, i: int, j: int, k: int, m: int) -> bool:
    """Whether the origin is not strictly on the side of a tetrahedron's face ``i j k`` where corner ``m`` is."""
    ux, uy, uz = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    vx, vy, vz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    origin = -(nx * p[i, 0] + ny * p[i, 1] + nz * p[i, 2])
    corner = nx * (p[m, 0] - p[i, 0]) + ny * (p[m, 1] - p[i, 1]) + nz * (p[m, 2] - p[i, 2])
    return not origin * corner > 0.0


@outlined
def _tetrahedron(p: Floats) -> tuple[float, float, float, int]:
    """Return the point of a tetrahedron that is nearest to the origin, and the corners that it needs as bits."""
    best, x, y, z, bits = math.inf, 0.0, 0.0, 0.0, 15
    for m in range(4):
        i, j, k = (m + 1) % 4, (m + 2) % 4, (m + 3) % 4
        if _outside(p, i, j, k, m):
            a, b, c, used = _triangle(p, i, j, k)
            square = a * a + b * b + c * c
            if square < best:
                best, x, y, z, bits = square, a, b, c, used
    return x, y, z, bits


@inlined
def _nearest(p: Floats, n: int) -> tuple[float, float, float, int]:
    """Return the point of a simplex of ``n`` points that is nearest to the origin, and the points it needs as bits."""
    if n == 1:
        return p[0, 0], p[0, 1], p[0, 2], 1
    if n == 2:
        return _segment(p, 0, 1)
    if n == 3:
        return _triangle(p, 0, 1, 2)
    return _tetrahedron(p)


@outlined
def convex_distance(corners: Corners, g: PairBuffers, enough: float) -> tuple[float, float]:
    """Return bounds on the distance of the two pieces in ``g`` [m], the lower one certified by ``g.normal``.

    Args:
        corners: Corners of hulls and triangles.
        g: The pieces; ``normal`` is the first direction.
        enough: Lower bound that suffices [m].

    Returns:
        Lower and upper bound; the upper one is infinite where it was not needed, and not positive for pieces that
        overlap.
    """
    around = radius(g, 0) + radius(g, 1)
    x, y, z = g.normal[0], g.normal[1], g.normal[2]
    lower, upper, n, p = -math.inf, math.inf, 0, g.simplex
    for _ in range(MOST_STEPS):
        long = math.sqrt(x * x + y * y + z * z)
        if not long > 1e-12:
            upper = 0.0
            break
        x, y, z = x / long, y / long, z / long
        a = support(corners, g, 0, x, y, z)
        b = support(corners, g, 1, -x, -y, -z)
        u, v, w = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        plane = x * u + y * v + z * w
        if plane > lower:
            lower = plane
            g.normal[0], g.normal[1], g.normal[2] = x, y, z
        if upper - lower <= TOLERANCE or lower - around >= enough:
            break
        known = False
        for k in range(n):
            known = known or (p[k, 0] == u and p[k, 1] == v and p[k, 2] == w)
        if known:
            break
        p[n, 0], p[n, 1], p[n, 2] = u, v, w
        x, y, z, bits = _nearest(p, n + 1)
        kept = 0
        for k in range(n + 1):
            if bits >> k & 1:
                p[kept, 0], p[kept, 1], p[kept, 2] = p[k, 0], p[k, 1], p[k, 2]
                kept += 1
        n = kept
        now = math.sqrt(x * x + y * y + z * z)
        if now >= upper:  # no progress, by rounding
            break
        upper = now
        if n == 4:  # the origin lies inside
            upper = 0.0
            break
    return lower - around, upper - around


@entry_point
def farthest_points(
    directions: Floats, points: Floats, first: Integers, middles: Floats, half: float, found: Integers
) -> None:
    """Find the point that is farthest in each direction; of points in cells only those in cells that may hold it.

    Args:
        directions: Shape (D, 3).
        points: Points in the order of their cells, shape (N, 3) [m].
        first: First point of each cell, and N, shape (cells + 1,).
        middles: Middles of the cells, shape (cells, 3) [m].
        half: Half of a cell's side, and what rounding may add [m].
        found: Gets the number of a point for each direction, shape (D,).
    """
    for k in range(len(directions)):
        x, y, z = directions[k, 0], directions[k, 1], directions[k, 2]
        wide, best = half * (abs(x) + abs(y) + abs(z)), -math.inf
        for c in range(len(middles)):  # a first bound
            n = first[c]
            reach = x * points[n, 0] + y * points[n, 1] + z * points[n, 2]
            if reach > best:
                best, found[k] = reach, n
        for c in range(len(middles)):
            if x * middles[c, 0] + y * middles[c, 1] + z * middles[c, 2] + wide <= best:
                continue
            for n in range(first[c], first[c + 1]):
                reach = x * points[n, 0] + y * points[n, 1] + z * points[n, 2]
                if reach > best:
                    best, found[k] = reach, n
