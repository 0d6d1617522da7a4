"""Exact shapes of bodies and obstacles as the kernel's flat arrays: primitives, hulls, and trees over triangles."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.hulls import below_support, convex_hull, hull_planes
from apex_ompl.collision.shapes import cloud_of, is_shell
from apex_ompl.kernel.arrays import (
    BOX,
    CAPSULE,
    CYLINDER,
    HALF_SPACE,
    HULL,
    POINT,
    SPHERE,
    TRIANGLE,
    Integers,
    ShapeArrays,
)
from apex_ompl.kernel.geometry import BallTree, tree_order
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import length
from apex_ompl.util.cache import kept, weakly_cached

CONVEX_TOLERANCE = 1e-7  # a mesh is its hull when its triangles' centers are no deeper than this below it [m]
MANY = 4000  # triangles
LARGE_HULL = 24  # corners, from which a search by neighbors is faster than one of all
OF_EACH = "kind", "joint", "points_of", "root", "graph", "rotation", "offset", "size", "ball", "depth"
"""Fields of the arrays that have a row for each shape."""

MOST_MESHES = 256  # that are kept

_meshes: dict[str, Mesh] = {}  # by shape key: robots are loaded anew for each plan


class Mesh(NamedTuple):
    """A mesh for the kernel.

    Attributes:
        points: Corners of its convex hull, or of the box around a cloud, shape (P, 3) [m].
        tree: Tree over its triangles, or over the points of a cloud; empty for a mesh that is its hull.
        depth: Depth of triangles' centers below the hull, 0 for a mesh that is its hull [m].
        edge_first: For each point of a large hull the first of its edges, and the end of the last; shape (P + 1,), else
            (0,).
        edge_end: The point at the other end of each edge, shape (edges,).
        radius: Radius of balls around points, which stand in place of triangles [m].
    """

    points: Array
    tree: BallTree
    depth: float = 0.0
    edge_first: NDArray[np.int64] = np.empty(0, np.int64)
    edge_end: NDArray[np.int64] = np.empty(0, np.int64)
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
        """Center and radius of a ball around the solid in the joint's frame, shape (4,) [m]; 0 for half-spaces."""
        (a, b, c), center = _size(self.geometry), np.zeros(3)
        radius = {BOX: length((a, b, c)), SPHERE: a, CYLINDER: length((a, b)), CAPSULE: a + b}
        if self.mesh is not None:
            points = self.mesh.points
            center = (points.min(axis=0) + points.max(axis=0)) / 2.0
            radius[HULL] = float(np.linalg.norm(points - center, axis=1).max())
        place = self.pose[:3, :3] @ center + self.pose[:3, 3]
        return np.append(place, radius.get(self.kind, 0.0) + 1e-12)


@weakly_cached
def mesh_of(geometry: coal.CollisionGeometry) -> Mesh:
    """Return the hull of a mesh or of a convex body, with a tree over its triangles where it is not convex.

    That of a cloud has a tree over its points.
    """
    if cloud_of(geometry) is not None:
        return _analyzed(geometry)
    return kept(_meshes, shape_key(geometry), lambda: _analyzed(geometry), MOST_MESHES)


def _analyzed(geometry: coal.CollisionGeometry) -> Mesh:
    cloud = cloud_of(geometry)
    if cloud is not None:
        points = np.ascontiguousarray(cloud.points[tree_order(cloud.points)])[:, None]
        return Mesh(np.array(geometry.points()), BallTree.over(points), np.inf, radius=cloud.radius)
    hull = convex_hull(geometry)
    none = BallTree(np.empty((0, 3, 3)), np.empty((0, 4)), np.empty((0, 3)), *(np.empty(0, np.int64),) * 2)
    mesh = Mesh(np.array(hull.points()), none, 0.0, *_edges(hull))
    if is_shell(geometry):
        vertices, faces = triangles(geometry)
        corners = vertices[faces]
        depth = _depth(hull, corners)
        if depth > CONVEX_TOLERANCE:
            corners = corners[tree_order(corners.mean(axis=1))]
            mesh = Mesh(mesh.points, BallTree.over(corners), depth, *_edges(hull))
    return mesh


def _edges(hull: coal.ConvexBase) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges of a hull of many corners, see :class:`Mesh`; a corner of no face has one, to one of a face."""
    count, empty = hull.num_points, np.empty(0, np.int64)
    if count < LARGE_HULL:
        return empty, empty
    faces = np.array([(row[0], row[1], row[2]) for row in map(hull.polygons, range(hull.num_polygons))])
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    alone = np.setdiff1d(np.arange(count), pairs)
    pairs = np.concatenate([pairs, pairs[:, ::-1], np.stack([alone, np.full_like(alone, faces[0, 0])], axis=1)])
    pairs = np.unique(pairs, axis=0)
    return np.searchsorted(pairs[:, 0], np.arange(count + 1)), np.ascontiguousarray(pairs[:, 1])


def _depth(hull: coal.CollisionGeometry, corners: Array) -> float:
    """Return the largest depth of a triangle's center below the faces of a hull [m], of many triangles that of some.

    Those that lie on the hull, seen by their own planes, are left out: comparing all triangles of a convex mesh with
    all faces takes the square of their number.
    """
    corners = corners[~_on_hull(hull, corners)]
    normals, offsets = hull_planes(hull)
    depth = 0.0
    if len(corners) > MANY:
        some = _depth(hull, corners[:: len(corners) // MANY + 1])
        if some > CONVEX_TOLERANCE:  # it is not convex, and the depth of the others matters little
            return some
    for first in range(0, len(corners), 1000):
        centers = corners[first : first + 1000].mean(axis=1)
        depth = max(depth, float((offsets - centers @ normals.T).min(axis=1).max()))
    return depth


def _on_hull(hull: coal.CollisionGeometry, corners: Array) -> Flags:
    """Whether triangles, shape (T, 3, 3) [m], are proved to be no deeper below a hull than ``CONVEX_TOLERANCE``."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    long = np.linalg.norm(normals, axis=1)
    normals = np.divide(normals, long[:, None], out=np.zeros_like(normals), where=long[:, None] > 0.0)
    points, centers = np.array(hull.points()), corners.mean(axis=1)
    outward = np.where(np.einsum("ij,ij->i", normals, centers - points.mean(axis=0)) < 0.0, -1.0, 1.0)
    depths = below_support(normals * outward[:, None], points, centers)
    return np.asarray((long > 0.0) & (depths <= CONVEX_TOLERANCE))


def shape_arrays(placed: Sequence[PlacedShape]) -> ShapeArrays:
    """Return the kernel's arrays of shapes."""
    points, point_count = [np.empty((0, 3))], 0
    nodes, halves = [np.empty((0, 4))], [np.empty((0, 3))]
    roots, spans, child, corner = [], [], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    graphs, edge_first, edge_end = [], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    node_count = edge_count = place = 0
    for shape in placed:
        mesh = shape.mesh
        if mesh is None:
            roots.append(-1)
            graphs.append(-1)
            spans.append((0, 0))
            continue
        graphs.append(place if len(mesh.edge_first) else -1)
        edge_first.append(mesh.edge_first + edge_count)
        edge_end.append(mesh.edge_end)
        place, edge_count = place + len(mesh.edge_first), edge_count + len(mesh.edge_end)
        spans.append((point_count, len(mesh.points)))
        point_count += len(mesh.points)
        tree = mesh.tree
        roots.append(node_count if len(tree.leaf) else -1)
        child.append(np.where(tree.child >= 0, tree.child + node_count, -1))
        each = tree.corners.shape[1]
        first = point_count + each * tree.leaf
        corner.append(np.where(tree.leaf < 0, -1, first if each == TRIANGLE else POINT - first))
        nodes.append(tree.balls)
        halves.append(tree.halves)
        points += [mesh.points, tree.corners.reshape(-1, 3)]
        point_count += each * len(tree.corners)
        node_count += len(tree.leaf)
    poses = [shape.row for shape in placed]
    return ShapeArrays(
        kind=np.array([s.kind for s in placed], np.int64),
        joint=np.array([s.joint for s in placed], np.int64),
        points_of=np.array(spans, np.int64).reshape(-1, 2),
        root=np.array(roots, np.int64),
        child=np.concatenate(child),
        corner=np.concatenate(corner),
        graph=np.array(graphs, np.int64),
        edge_first=np.concatenate(edge_first),
        edge_end=np.concatenate(edge_end),
        rotation=np.array([pose[0] for pose in poses]).reshape(-1, 3, 3),
        offset=np.array([pose[1] for pose in poses]).reshape(-1, 3),
        size=np.array([pose[2] for pose in poses]).reshape(-1, 3),
        ball=np.array([shape.ball for shape in placed]).reshape(-1, 4),
        depth=np.array([0.0 if s.mesh is None else s.mesh.depth for s in placed]),
        node_ball=np.concatenate(nodes),
        node_half=np.concatenate(halves),
        points=np.concatenate(points),
    )


def joined(bodies: ShapeArrays, others: ShapeArrays) -> ShapeArrays:
    """Return the shapes of bodies, followed by others."""
    pairs = zip(bodies, placed_after(bodies, others), strict=True)
    return ShapeArrays(*(np.concatenate(pair) for pair in pairs))


def placed_after(bodies: ShapeArrays, others: ShapeArrays) -> ShapeArrays:
    """Return shapes whose points, nodes and edges have the places that they get after those of bodies."""
    points, nodes, edges = len(bodies.points), len(bodies.child), len(bodies.edge_end)
    return others._replace(
        points_of=others.points_of + np.array([points, 0], np.int64), root=_moved(others.root, nodes),
        child=_moved(others.child, nodes), graph=_moved(others.graph, len(bodies.edge_first)),
        edge_first=others.edge_first + edges,
        corner=np.where(others.corner <= POINT, others.corner - points, _moved(others.corner, points)),
    )  # fmt: skip


def rearranged(shapes: ShapeArrays, order: Sequence[int]) -> ShapeArrays:
    """Return shapes in another order, given by their places in this one."""
    chosen = np.array(order, np.int64)
    return shapes._replace(**{name: getattr(shapes, name)[chosen] for name in OF_EACH})


def _moved(numbers: Integers, by: int) -> Integers:
    """Return numbers plus ``by``; -1, which stands for nothing, stays."""
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


def shape_digest(geometry: coal.CollisionGeometry) -> bytes:
    """Return the key of a shape, which is of rounded numbers, and a digest of its content to the last bit."""
    return shape_key(geometry).encode() + _content(geometry)


@weakly_cached
def _content(geometry: coal.CollisionGeometry) -> bytes:
    digest = hashlib.sha256()
    if is_shell(geometry):
        for array in triangles(geometry):
            digest.update(array.tobytes())
    elif geometry.getNodeType() == coal.GEOM_CONVEX:
        digest.update(np.array(geometry.points()).tobytes())
    cloud = cloud_of(geometry)
    if cloud is not None:
        digest.update(cloud.points.tobytes() + repr(cloud.radius).encode())
    return digest.digest()
