"""Triangles and meshes of them: distances of points, whether a mesh encloses a point, and its extent in columns."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined, outlined
from apex_ompl.kernel.compiled.layout import Floats, Integers

Corner = Floats | tuple[float, float, float]


@inlined
def closest_shares(
    ux: float, uy: float, uz: float, vx: float, vy: float, vz: float, px: float, py: float, pz: float
) -> tuple[float, float]:
    """Return s and r of the point s u + r v closest to p of a triangle with a corner at 0 (Ericson 2005, 5.1.5)."""
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    d3, d4, d5, d6 = d1 - uu, d2 - uv, d1 - uv, d2 - vv
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        s, r = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        s, r = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        s, r = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, r = d1 / (d1 - d3) if d1 > d3 else 0.0, 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s, r = 0.0, d2 / (d2 - d6) if d2 > d6 else 0.0
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        r = (d4 - d3) / ((d4 - d3) + (d5 - d6)) if d4 - d3 + d5 - d6 > 0.0 else 0.0
        s = 1.0 - r
    else:
        whole = va + vb + vc
        s, r = vb / whole, vc / whole
    return s, r


@inlined
def squared_distance(a: Corner, b: Corner, c: Corner, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point to a triangle with given corners, shape (3,)."""
    ax, ay, az = a[0], a[1], a[2]
    ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
    vx, vy, vz = c[0] - ax, c[1] - ay, c[2] - az
    px, py, pz = x - ax, y - ay, z - az
    s, r = closest_shares(ux, uy, uz, vx, vy, vz, px, py, pz)
    dx, dy, dz = px - s * ux - r * vx, py - s * uy - r * vy, pz - s * uz - r * vz
    squared: float = dx * dx + dy * dy + dz * dz
    return squared


@inlined
def closest_squared(corners: Floats, t: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point to triangle ``t``."""
    return squared_distance(corners[t, 0], corners[t, 1], corners[t, 2], x, y, z)


@entry_point
def surface_distances(
    points: Floats, corners: Floats, balls: Floats, child: Integers, leaf: Integers, stack: Integers, limit: float,
    distances: Floats,
) -> None:  # fmt: skip
    """Put the distances of points from the nearest triangle into place, at most a limit.

    Args:
        points: Shape (N, 3) [m].
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        balls: Nodes of a tree over them, see :func:`apex_ompl.collision.exact_shapes.ball_tree`, shape (n, 4) [m].
        child: First child of each node, shape (n,).
        leaf: Triangle of each leaf, shape (n,).
        stack: Room, longer than the tree is deep.
        limit: Largest distance of interest [m].
        distances: Shape (N,) [m].
    """
    for p in range(len(points)):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        best, top = limit, 1
        stack[0] = 0
        while top > 0:
            top -= 1
            n = stack[top]
            apart = math.sqrt((x - balls[n, 0]) ** 2 + (y - balls[n, 1]) ** 2 + (z - balls[n, 2]) ** 2) - balls[n, 3]
            if apart >= best:
                continue
            if child[n] < 0:
                best = min(best, math.sqrt(closest_squared(corners, leaf[n], x, y, z)))
            else:
                stack[top], stack[top + 1] = child[n], child[n] + 1
                top += 2
        distances[p] = best


CORNERS = 9
"""Most corners of a triangle that was cut by four planes, and two to spare."""


@inlined
def _passes(y0: float, z0: float, y1: float, z1: float, y: float, z: float) -> int:
    """Return 1 where a directed edge passes below a point (in z) towards +y, -1 towards -y, and 0 elsewhere.

    Both triangles at an edge get the opposite of each other bit for bit: the edge is taken from its lower end.
    """
    if y0 <= y < y1:
        return 1 if (y1 - y0) * (z - z0) > (z1 - z0) * (y - y0) else 0
    if y1 <= y < y0:
        return -1 if (y0 - y1) * (z - z1) > (z0 - z1) * (y - y1) else 0
    return 0


@inlined
def _volume(corners: Floats, t: int, x: float, y: float, z: float) -> float:
    """Return six times the signed volume of the tetrahedron of a point and a triangle, positive on its inner side."""
    ax, ay, az = corners[t, 0, 0] - x, corners[t, 0, 1] - y, corners[t, 0, 2] - z
    bx, by, bz = corners[t, 1, 0] - x, corners[t, 1, 1] - y, corners[t, 1, 2] - z
    cx, cy, cz = corners[t, 2, 0] - x, corners[t, 2, 1] - y, corners[t, 2, 2] - z
    volume: float = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    return volume


@inlined
def _crossings(corners: Floats, x: float, y: float, z: float) -> int:
    """Return how often a ray along +x leaves a mesh, less how often it enters: the winding number of a closed mesh.

    A triangle meets the ray only if its projection onto the plane of y and z contains the point. The projections of
    neighbors share an edge bit for bit, so a ray through an edge or a corner is counted once.
    """
    total = 0
    for t in range(corners.shape[0]):
        y0, y1, y2 = corners[t, 0, 1], corners[t, 1, 1], corners[t, 2, 1]
        if max(y0, y1, y2) <= y or min(y0, y1, y2) > y:
            continue
        x0, x1, x2 = corners[t, 0, 0], corners[t, 1, 0], corners[t, 2, 0]
        if max(x0, x1, x2) < x:
            continue
        z0, z1, z2 = corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2]
        turn = _passes(y0, z0, y1, z1, y, z) + _passes(y1, z1, y2, z2, y, z) + _passes(y2, z2, y0, z0, y, z)
        if turn != 0 and (min(x0, x1, x2) > x or _volume(corners, t, x, y, z) * turn > 0.0):
            total += turn
    return total


@inlined
def _solid_angle(corners: Floats, x: float, y: float, z: float) -> float:
    """Return the winding number of a mesh around a point, its solid angle over 4 pi (van Oosterom, Strackee 1983)."""
    total = 0.0
    for t in range(corners.shape[0]):
        ax, ay, az = corners[t, 0, 0] - x, corners[t, 0, 1] - y, corners[t, 0, 2] - z
        bx, by, bz = corners[t, 1, 0] - x, corners[t, 1, 1] - y, corners[t, 1, 2] - z
        cx, cy, cz = corners[t, 2, 0] - x, corners[t, 2, 1] - y, corners[t, 2, 2] - z
        a, b, c = (
            math.sqrt(ax * ax + ay * ay + az * az),
            math.sqrt(bx * bx + by * by + bz * bz),
            math.sqrt(cx * cx + cy * cy + cz * cz),
        )
        ab, bc, ca = ax * bx + ay * by + az * bz, bx * cx + by * cy + bz * cz, cx * ax + cy * ay + cz * az
        total += math.atan2(_volume(corners, t, x, y, z), a * b * c + ab * c + bc * a + ca * b)
    return total / (2.0 * math.pi)


@outlined
def is_inside(corners: Floats, box: Floats, watertight: bool, x: float, y: float, z: float) -> bool:
    """Return :func:`encloses` for compiled code."""
    if not (box[0, 0] <= x <= box[1, 0] and box[0, 1] <= y <= box[1, 1] and box[0, 2] <= z <= box[1, 2]):
        return False
    if watertight:
        return _crossings(corners, x, y, z) != 0
    return abs(_solid_angle(corners, x, y, z)) > 0.5


@entry_point
def encloses(corners: Floats, box: Floats, watertight: bool, x: float, y: float, z: float) -> bool:
    """Whether the winding number of a mesh around a point that is not on its surface exceeds 1/2, without its sign.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        box: Bounding box of the mesh, shape (2, 3) [m].
        watertight: Whether each edge occurs equally often in both directions, bit for bit: winding numbers are
            whole numbers then, which crossings of a ray give.
        x: Place of the point [m].
        y: The same.
        z: The same.
    """
    return is_inside(corners, box, watertight, x, y, z)


@inlined
def _cut(points: Floats, source: int, count: int, axis: int, sign: float, bound: float) -> int:
    """Cut a convex polygon by the half-space ``sign * p[axis] <= sign * bound``; the rest goes to the other buffer.

    Returns:
        The number of corners of the rest.
    """
    kept = 0
    for k in range(count):
        following = k + 1 if k + 1 < count else 0
        here, there = sign * (bound - points[source, k, axis]), sign * (bound - points[source, following, axis])
        if here >= 0.0:
            for j in range(3):
                points[1 - source, kept, j] = points[source, k, j]
            kept += 1
        if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
            share = here / (here - there)
            for j in range(3):
                p, q = points[source, k, j], points[source, following, j]
                points[1 - source, kept, j] = p + share * (q - p)
            points[1 - source, kept, axis] = bound
            kept += 1
    return kept


@inlined
def _cell(value: float, low: float, width: float, columns: int) -> int:
    return min(max(int((value - low) / width), 0), columns - 1)


@entry_point
def column_boxes(corners: Floats, low: Floats, width: Floats, pad: float, points: Floats, boxes: Floats) -> None:
    """Write the bounding boxes of the parts of a surface in columns along each axis.

    A triangle is cut to each column that it reaches into, widened by ``pad``.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        low: Least corner of the surface, shape (3,) [m].
        width: Widths of columns, shape (3,) [m].
        pad: Margin of columns against rounding [m].
        points: Buffer for polygons, shape (2, CORNERS, 3).
        boxes: Boxes of columns, shape (3, C, C, 2, 3) [m]: along which axis, the places along the other two axes in
            ascending order, least and largest corner. Only grown: infinite boxes of the wrong sign are given.
    """
    columns = boxes.shape[1]
    for t in range(corners.shape[0]):
        for axis in range(3):
            u, v = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
            u_least = min(corners[t, 0, u], corners[t, 1, u], corners[t, 2, u]) - pad
            u_most = max(corners[t, 0, u], corners[t, 1, u], corners[t, 2, u]) + pad
            v_least = min(corners[t, 0, v], corners[t, 1, v], corners[t, 2, v]) - pad
            v_most = max(corners[t, 0, v], corners[t, 1, v], corners[t, 2, v]) + pad
            for i in range(_cell(u_least, low[u], width[u], columns), _cell(u_most, low[u], width[u], columns) + 1):
                u_low = low[u] + i * width[u]
                for j in range(_cell(v_least, low[v], width[v], columns), _cell(v_most, low[v], width[v], columns) + 1):
                    v_low = low[v] + j * width[v]
                    for k in range(3):
                        for m in range(3):
                            points[0, k, m] = corners[t, k, m]
                    count = 3
                    for cut in range(4):
                        along, below = (u if cut < 2 else v), cut % 2 == 0
                        bound = (u_low if cut < 2 else v_low) + (-pad if below else width[along] + pad)
                        count = _cut(points, cut % 2, count, along, -1.0 if below else 1.0, bound)
                    for k in range(count):
                        for m in range(3):
                            boxes[axis, i, j, 0, m] = min(boxes[axis, i, j, 0, m], points[0, k, m])
                            boxes[axis, i, j, 1, m] = max(boxes[axis, i, j, 1, m], points[0, k, m])
