"""Whether points of a cloud are near a solid or inside of it, by trees of balls over both."""

from __future__ import annotations

import math

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
from apex_ompl.kernel.compiled.geometry.signed_distance import primitive_distance
from apex_ompl.kernel.compiled.geometry.triangles import closest_squared, is_inside
from apex_ompl.kernel.compiled.layout import Floats, Integers

Point = tuple[float, float, float]


@inlined
def _local(pose: Floats, x: float, y: float, z: float) -> Point:
    """Return a point in the frame of a pose, shape (4, 4)."""
    dx, dy, dz = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    return (
        pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz,
        pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz,
        pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz,
    )


@inlined
def _from_box(ball: Floats, half: Floats, x: float, y: float, z: float) -> float:
    """Return the distance of a point from a box around the center of a node's ball [m]."""
    x, y, z = abs(x - ball[0]) - half[0], abs(y - ball[1]) - half[1], abs(z - ball[2]) - half[2]
    return float(math.sqrt(max(x, 0.0) ** 2 + max(y, 0.0) ** 2 + max(z, 0.0) ** 2))


@inlined
def _world(pose: Floats, ball: Floats) -> Point:
    """Return the center of a ball that is given in the frame of a pose, shape (4, 4)."""
    return (
        pose[0, 0] * ball[0] + pose[0, 1] * ball[1] + pose[0, 2] * ball[2] + pose[0, 3],
        pose[1, 0] * ball[0] + pose[1, 1] * ball[1] + pose[1, 2] * ball[2] + pose[1, 3],
        pose[2, 0] * ball[0] + pose[2, 1] * ball[1] + pose[2, 2] * ball[2] + pose[2, 3],
    )


@entry_point
def near_mesh(
    points: Floats, point_balls: Floats, point_halves: Floats, point_child: Integers, point_leaf: Integers,
    corners: Floats, balls: Floats, halves: Floats, child: Integers, leaf: Integers,
    pose: Floats, limit: float, stack: Integers,
) -> bool:  # fmt: skip
    """Whether any of the points is within a distance of any triangle of a mesh.

    Args:
        points: Shape (N, 1, 3) [m].
        point_balls: Nodes of a tree over them, see :func:`apex_ompl.collision.exact_shapes.ball_tree`.
        point_halves: Half edges of their boxes [m].
        point_child: First child of each node.
        point_leaf: Point of each leaf.
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        balls: Nodes of a tree over them.
        halves: Half edges of their boxes [m].
        child: First child of each node.
        leaf: Triangle of each leaf.
        pose: Pose of the mesh in the frame of the points, shape (4, 4) [m].
        limit: The distance [m].
        stack: Buffer for pairs of nodes, shape (n, 2), n longer than both trees are deep.
    """
    top = 1
    stack[0, 0] = stack[0, 1] = 0
    while top > 0:
        top -= 1
        m, n = stack[top, 0], stack[top, 1]
        x, y, z = _local(pose, point_balls[m, 0], point_balls[m, 1], point_balls[m, 2])
        if _from_box(balls[n], halves[n], x, y, z) > limit + point_balls[m, 3]:
            continue
        x, y, z = _world(pose, balls[n])
        if _from_box(point_balls[m], point_halves[m], x, y, z) > limit + balls[n, 3]:
            continue
        if point_child[m] < 0 and child[n] < 0:
            p = point_leaf[m]
            x, y, z = _local(pose, points[p, 0, 0], points[p, 0, 1], points[p, 0, 2])
            if closest_squared(corners, leaf[n], x, y, z) <= limit * limit:
                return True
        elif child[n] < 0 or (point_child[m] >= 0 and point_balls[m, 3] >= balls[n, 3]):
            stack[top, 0], stack[top, 1] = point_child[m], n
            stack[top + 1, 0], stack[top + 1, 1] = point_child[m] + 1, n
            top += 2
        else:
            stack[top, 0], stack[top, 1] = m, child[n]
            stack[top + 1, 0], stack[top + 1, 1] = m, child[n] + 1
            top += 2
    return False


@entry_point
def any_inside(
    points: Floats, point_balls: Floats, point_child: Integers, point_leaf: Integers,
    corners: Floats, box: Floats, watertight: bool, normals: Floats, offsets: Floats, pose: Floats, stack: Integers,
) -> bool:  # fmt: skip
    """Whether any of the points is inside of a mesh, none being on its surface.

    Args:
        points: Shape (N, 1, 3) [m].
        point_balls: Nodes of a tree over them.
        point_child: First child of each node.
        point_leaf: Point of each leaf.
        corners: Corners of the triangles, see :func:`apex_ompl.kernel.compiled.geometry.triangles.encloses`.
        box: Bounding box of the mesh, shape (2, 3) [m].
        watertight: Whether winding numbers are whole numbers.
        normals: Outward unit normals of its convex hull, shape (P, 3).
        offsets: Offsets of its planes, shape (P,) [m].
        pose: Pose of the mesh in the frame of the points, shape (4, 4) [m].
        stack: Buffer for nodes, shape (n, 2).
    """
    top = 1
    stack[0, 0] = 0
    while top > 0:
        top -= 1
        m = stack[top, 0]
        x, y, z = _local(pose, point_balls[m, 0], point_balls[m, 1], point_balls[m, 2])
        outside = False
        for k in range(len(offsets)):
            if normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z - offsets[k] > point_balls[m, 3]:
                outside = True
                break
        if outside:
            continue
        if point_child[m] >= 0:
            stack[top, 0], stack[top + 1, 0] = point_child[m], point_child[m] + 1
            top += 2
            continue
        p = point_leaf[m]
        x, y, z = _local(pose, points[p, 0, 0], points[p, 0, 1], points[p, 0, 2])
        if is_inside(corners, box, watertight, x, y, z):
            return True
    return False


@entry_point
def near_primitive(
    points: Floats, point_balls: Floats, point_child: Integers, point_leaf: Integers,
    kind: int, size: Floats, pose: Floats, limit: float, stack: Integers,
) -> bool:  # fmt: skip
    """Whether any of the points is within a distance of a primitive, or inside of it.

    Args:
        points: Shape (N, 1, 3) [m].
        point_balls: Nodes of a tree over them.
        point_child: First child of each node.
        point_leaf: Point of each leaf.
        kind: BOX, SPHERE, CYLINDER or CAPSULE.
        size: Half edges; radius; or radius and half length, shape (3,) [m].
        pose: Pose of the primitive in the frame of the points, shape (4, 4) [m].
        limit: The distance [m].
        stack: Buffer for nodes, shape (n, 2).
    """
    top = 1
    stack[0, 0] = 0
    while top > 0:
        top -= 1
        m = stack[top, 0]
        x, y, z = _local(pose, point_balls[m, 0], point_balls[m, 1], point_balls[m, 2])
        if primitive_distance(kind, size, x, y, z) - point_balls[m, 3] > limit:
            continue
        if point_child[m] >= 0:
            stack[top, 0], stack[top + 1, 0] = point_child[m], point_child[m] + 1
            top += 2
            continue
        p = point_leaf[m]
        x, y, z = _local(pose, points[p, 0, 0], points[p, 0, 1], points[p, 0, 2])
        if primitive_distance(kind, size, x, y, z) <= limit:
            return True
    return False


@entry_point
def primitive_distances(points: Floats, kind: int, size: Floats, distances: Floats) -> None:
    """Put the signed distances of points, shape (N, 3) [m], from a primitive in its frame into ``distances`` (N,)."""
    for p in range(len(points)):
        distances[p] = primitive_distance(kind, size, points[p, 0], points[p, 1], points[p, 2])
