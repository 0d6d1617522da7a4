"""Exact shapes of bodies and obstacles as the kernel's flat arrays: primitives, hulls, and trees over triangles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.clouds import cloud_of
from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.shapes import convex_hull, hull_planes, is_shell
from apex_ompl.kernel.compiled.arrays import BOX, CAPSULE, CYLINDER, HALF_SPACE, SPHERE
from apex_ompl.kernel.compiled.ball_tree import median_order, node_balls
from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.shapes import HULL, POINT, TRIANGLE, ShapeArrays
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array
from apex_ompl.util.weak_cache import weakly_cached

CONVEX_TOLERANCE = 1e-7  # a mesh is its hull when its triangles' centres are no deeper than this below it [m]
MANY = 4000  # triangles


MOST_MESHES = 256  # that are kept

_meshes: dict[str, Mesh] = {}  # by shape key: robots are loaded anew for each plan


class Mesh(NamedTuple):
    """A mesh for the kernel.

    Attributes:
        points: Corners of its convex hull, shape (P, 3) [m].
        corners: Corners of its triangles in the tree's order, shape (T, 3, 3) [m]; none for a mesh that is its hull.
        balls: Centre and radius around the triangles below each node of the tree, shape (2 T - 1, 4) [m].
        child: First child of each node, -1 for leaves, shape (2 T - 1,).
        leaf: Triangle of each leaf, -1 for inner nodes, shape (2 T - 1,).
        depth: Depth of triangles' centres below the hull, 0 for a mesh that is its hull [m].
        radius: Radius of balls around points, which stand in place of triangles [m].
    """

    points: Array
    corners: Array
    balls: Array
    child: NDArray[np.int64]
    leaf: NDArray[np.int64]
    depth: float = 0.0
    radius: float = 0.0


@dataclass(frozen=True, eq=False)
class PlacedShape:
    """A shape that is fixed to a joint.

    Attributes:
        geometry: The shape.
        joint: Joint of the kernel.
        pose: Pose in the joint's frame, shape (4, 4) [m].
    """

    geometry: coal.CollisionGeometry
    joint: int
    pose: Array

    @cached_property
    def kind(self) -> int:
        """Kind of the shape in the kernel: BOX ... HALF_SPACE or HULL."""
        return _kind(self.geometry)

    @cached_property
    def mesh(self) -> Mesh | None:
        """The mesh for the kernel, None for primitives."""
        return mesh_of(self.geometry) if self.kind == HULL else None

    @cached_property
    def row(self) -> tuple[Array, Sequence[float] | Array, Sequence[float]]:
        """Rotation, offset and size; a half-space has its normal as offset and its distance as size."""
        shape, pose = self.geometry, self.pose
        if self.mesh is not None:
            return pose[:3, :3], pose[:3, 3], (self.mesh.radius, 0.0, 0.0)
        if self.kind != HALF_SPACE:
            return pose[:3, :3], pose[:3, 3], _size(shape)
        normal = pose[:3, :3] @ shape.n
        return np.eye(3), normal, (shape.d + float(normal @ pose[:3, 3]), 0.0, 0.0)

    @cached_property
    def ball(self) -> Array:
        """Centre and radius of a ball around the solid in the joint's frame, shape (4,) [m]; 0 for half-spaces."""
        (a, b, c), centre = _size(self.geometry), np.zeros(3)
        radius = {BOX: float(np.linalg.norm((a, b, c))), SPHERE: a, CYLINDER: float(np.hypot(a, b)), CAPSULE: a + b}
        if self.mesh is not None:
            points = self.mesh.points
            centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
            radius[HULL] = float(np.linalg.norm(points - centre, axis=1).max())
        place = self.pose[:3, :3] @ centre + self.pose[:3, 3]
        return np.append(place, radius.get(self.kind, 0.0) + 1e-12)


@weakly_cached
def mesh_of(geometry: coal.CollisionGeometry) -> Mesh:
    """Return the hull of a mesh or of a convex body, with a tree over its triangles where it is not convex.

    That of a cloud has a tree over its points.
    """
    if cloud_of(geometry) is not None:
        return _analysed(geometry)
    key = shape_key(geometry)
    if key not in _meshes:
        while len(_meshes) >= MOST_MESHES:
            _meshes.pop(next(iter(_meshes)), None)
        _meshes[key] = _analysed(geometry)
    return _meshes[key]


def _analysed(geometry: coal.CollisionGeometry) -> Mesh:
    cloud = cloud_of(geometry)
    if cloud is not None:
        points = np.ascontiguousarray(cloud.points[_order(cloud.points)])[:, None]
        return Mesh(np.array(geometry.points()), points, *ball_tree(points), np.inf, cloud.radius)
    hull = convex_hull(geometry)
    mesh = Mesh(np.array(hull.points()), np.empty((0, 3, 3)), np.empty((0, 4)), *(np.empty(0, np.int64),) * 2)
    if is_shell(geometry):
        vertices, faces = triangles(geometry)
        corners = vertices[faces]
        depth = _depth(hull, corners)
        if depth > CONVEX_TOLERANCE:
            corners = corners[_order(corners.mean(axis=1))]
            mesh = Mesh(mesh.points, corners, *ball_tree(corners), depth)
    return mesh


def _depth(hull: coal.CollisionGeometry, corners: Array) -> float:
    """Return the largest depth of a triangle's centre below the faces of a hull [m], of many triangles that of some."""
    normals, offsets = hull_planes(hull)
    depth = 0.0
    if len(corners) > MANY:
        some = _depth(hull, corners[:: len(corners) // MANY + 1])
        if some > CONVEX_TOLERANCE:  # it is not convex, and the depth of the others matters little
            return some
    for first in range(0, len(corners), 1000):
        centres = corners[first : first + 1000].mean(axis=1)
        depth = max(depth, float((offsets - centres @ normals.T).min(axis=1).max()))
    return depth


def _order(centres: Array) -> NDArray[np.int64]:
    """Return points in the order of a tree whose nodes are halved across their longest sides."""
    order = np.arange(len(centres))
    median_order(np.ascontiguousarray(centres), order, np.empty((128, 2), np.int64))
    return order


def ball_tree(corners: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Return a binary tree over triangles or points in their order, shape (T, k, 3) [m]: balls, children and leaves.

    Each node holds a range of triangles, its children the two halves; nodes stand level by level. The ball of a node
    has the centre of its bounding box.
    """
    first, last = np.zeros(1, np.int64), np.array([len(corners)])
    firsts, lasts, child, leaf, count = [], [], [], [], 1
    while len(first):
        firsts.append(first)
        lasts.append(last)
        inner = last - first > 1
        number = np.full(len(first), -1, np.int64)
        number[inner] = count + 2 * np.arange(int(inner.sum()))
        child.append(number)
        leaf.append(np.where(inner, -1, first))
        count += 2 * int(inner.sum())
        middle = (first + last)[inner] // 2
        first = np.stack([first[inner], middle], axis=1).ravel()
        last = np.stack([middle, last[inner]], axis=1).ravel()
    balls = np.empty((count, 4))
    node_balls(np.ascontiguousarray(corners), np.concatenate(firsts), np.concatenate(lasts), balls)
    return balls, np.concatenate(child), np.concatenate(leaf)


def shape_arrays(shapes: Mapping[int, PlacedShape]) -> ShapeArrays:
    """Return the kernel's arrays of shapes by their numbers."""
    numbers = list(shapes)
    row = np.full(max(numbers, default=-1) + 1, -1, np.int64)
    row[numbers] = np.arange(len(numbers))
    placed, points, nodes, point_count = list(shapes.values()), [np.empty((0, 3))], [], 0
    roots, spans, child, corner = [], [], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    node_count = 0
    for shape in placed:
        mesh = shape.mesh
        if mesh is None:
            roots.append(-1)
            spans.append((0, 0))
            continue
        spans.append((point_count, len(mesh.points)))
        point_count += len(mesh.points)
        roots.append(node_count if len(mesh.leaf) else -1)
        child.append(np.where(mesh.child >= 0, mesh.child + node_count, -1))
        each = mesh.corners.shape[1]
        first = point_count + each * mesh.leaf
        corner.append(np.where(mesh.leaf < 0, -1, first if each == TRIANGLE else POINT - first))
        nodes.append(mesh.balls)
        points += [mesh.points, mesh.corners.reshape(-1, 3)]
        point_count += each * len(mesh.corners)
        node_count += len(mesh.leaf)
    poses = [shape.row for shape in placed]
    return ShapeArrays(
        kind=np.array([s.kind for s in placed], np.int64),
        joint=np.array([s.joint for s in placed], np.int64),
        points_of=np.array(spans, np.int64).reshape(-1, 2),
        root=np.array(roots, np.int64),
        child=np.concatenate(child),
        corner=np.concatenate(corner),
        row=row,
        rotation=np.array([pose[0] for pose in poses]).reshape(-1, 3, 3),
        offset=np.array([pose[1] for pose in poses]).reshape(-1, 3),
        size=np.array([pose[2] for pose in poses]).reshape(-1, 3),
        ball=np.array([shape.ball for shape in placed]).reshape(-1, 4),
        depth=np.array([0.0 if s.mesh is None else s.mesh.depth for s in placed]),
        node_ball=np.concatenate([np.empty((0, 4)), *nodes]),
        points=np.concatenate(points),
    )


def joined(bodies: ShapeArrays, obstacles: ShapeArrays) -> ShapeArrays:
    """Return the shapes of bodies, whose rows are kept, and of obstacles behind them; ``row`` is the obstacles'."""
    points, nodes = len(bodies.points), len(bodies.child)
    moved = obstacles._replace(
        points_of=obstacles.points_of + np.array([points, 0], np.int64), root=_moved(obstacles.root, nodes),
        child=_moved(obstacles.child, nodes),
        corner=np.where(obstacles.corner <= POINT, obstacles.corner - points, _moved(obstacles.corner, points)),
    )  # fmt: skip
    both = ShapeArrays(*(np.concatenate(pair) for pair in zip(bodies, moved, strict=True)))
    return both._replace(row=_moved(obstacles.row, len(bodies.kind)))


def _moved(numbers: Integers, by: int) -> Integers:
    """Return numbers plus ``by``, but for those that stand for nothing, -1."""
    return np.where(numbers >= 0, numbers + by, -1)


def _kind(shape: coal.CollisionGeometry) -> int:
    kinds = {coal.GEOM_BOX: BOX, coal.GEOM_SPHERE: SPHERE, coal.GEOM_CYLINDER: CYLINDER}
    kinds |= {coal.GEOM_CAPSULE: CAPSULE, coal.GEOM_HALFSPACE: HALF_SPACE}
    return kinds.get(shape.getNodeType(), HULL)


def _size(shape: coal.CollisionGeometry) -> tuple[float, ...]:
    kind = _kind(shape)
    if kind == BOX:
        return tuple(shape.halfSide)
    if kind == SPHERE:
        return (shape.radius, 0.0, 0.0)
    return (shape.radius, shape.halfLength, 0.0) if kind in (CYLINDER, CAPSULE) else (0.0, 0.0, 0.0)
