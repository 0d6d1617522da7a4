"""Contact of solids with point clouds: distances of points from boxes, round bodies and the triangles of meshes."""

from __future__ import annotations

from collections.abc import Iterable

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.collision.clouds import PointCloud, cloud_of
from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.exact_shapes import Mesh, PlacedShape, ball_tree, mesh_of
from apex_ompl.collision.shapes import coal_geometry, hull_planes, is_shell
from apex_ompl.collision.solids import Solid
from apex_ompl.kernel.compiled.cloud_distance import any_inside, near_mesh, near_primitive
from apex_ompl.kernel.compiled.nearest_triangle import surface_distances
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array, Indices
from apex_ompl.util.validation import check_array, check_number, finite_array
from apex_ompl.util.weak_cache import weakly_cached

SOME = 10_000  # points
STACK = 128  # nodes that wait in a walk down a tree
LARGEST_MARGIN = 1.0  # [m]
NEARLY = 1e-6  # beyond a limit [m]


def touches(cloud: PointCloud, cloud_shape: coal.CollisionGeometry, solid: PlacedShape) -> bool:
    """Whether a solid reaches into the balls of a cloud.

    Args:
        cloud: The cloud.
        cloud_shape: The geometry that stands for it.
        solid: The solid, at its pose in the cloud's frame.
    """
    shape, pose = solid.geometry, np.ascontiguousarray(solid.pose)
    tree, stack = mesh_of(cloud_shape), np.empty((STACK, 2), np.int64)
    points = tree.corners, tree.balls, tree.child, tree.leaf
    if not is_shell(shape):
        size = np.zeros(3)
        numbers = solid.row[2]
        size[: len(numbers)] = numbers
        return bool(near_primitive(*points, solid.kind, size, pose, cloud.radius, stack))
    own = _surface(shape)
    mesh = own.corners, own.balls, own.child, own.leaf
    if near_mesh(*points, *mesh, pose, cloud.radius, stack):
        return True
    outer, planes = EnclosingMesh.of(shape), _planes(shape)
    return bool(any_inside(*points, outer.corners, outer.box, outer.watertight, *planes, pose, stack))


def nearest_balls(solid: Solid, boxes: Array) -> list[Solid]:
    """Return a solid, or of a cloud the balls that are nearest to boxes in the world, shape (n, 2, 3) [m].

    Of many points every few are looked at.
    """
    cloud = cloud_of(solid.shape)
    if cloud is None:
        return [solid]
    points = cloud.points[:: len(cloud.points) // SOME + 1] @ solid.placement.rotation.T + solid.placement.translation
    chosen = set()
    for low, high in boxes:
        chosen.add(int(np.argmin((np.maximum(np.maximum(low - points, points - high), 0.0) ** 2).sum(axis=1))))
    return [Solid(solid.name, 0, pin.SE3(np.eye(3), points[k]), coal.Sphere(cloud.radius)) for k in sorted(chosen)]


@weakly_cached
def _planes(shape: coal.BVHModelBase) -> tuple[Array, Array]:
    """Return normals and offsets of the planes of a mesh's hull."""
    normals, offsets = hull_planes(EnclosingMesh.of(shape).hull)
    return np.ascontiguousarray(normals), np.ascontiguousarray(offsets)


def cloud_depth(cloud: PointCloud, shape: coal.CollisionGeometry, pose: Array) -> float:
    """Return how deep a solid reaches into the balls of a cloud, negative where it does not [m].

    It is that of the deepest ball.

    Args:
        cloud: The cloud.
        shape: The solid.
        pose: Its pose in the cloud's frame, shape (4, 4) [m].
    """
    near = cloud.inside(_box_at(shape, pose))
    if not len(near):
        return -np.inf
    local = (near - pose[:3, 3]) @ pose[:3, :3]
    return cloud.radius - float(signed_distances(shape, local, cloud.radius + NEARLY).min())


def filter_points(
    points: ArrayLike, robot: Robot, state: ArrayLike, margin: float = 0.02, held: Iterable[AttachedObject] = ()
) -> Array:
    """Return the points that are not on the robot or on what it holds, shape (n, 3) [m].

    Args:
        points: Points in the world, shape (N, 3) [m].
        robot: The robot.
        state: Its state, shape (dof,).
        margin: Distance up to which a point is taken for one of the robot or a held object [m].
        held: What it holds.

    Raises:
        ParameterError: An argument has another shape, or is out of its range.
        UnknownNameError: An unknown link holds an object.
    """
    cloud = finite_array(points, "points")
    check_array(cloud, (len(cloud), 3) if cloud.ndim else (0, 3), "points")
    q = finite_array(state, "state")
    check_array(q, (robot.dof,), "state")
    check_number(margin, "margin", 0.0, LARGEST_MARGIN)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    items = [(g.geometry, (data.oMi[g.parentJoint] * g.placement).homogeneous) for g in robot.geometry.geometryObjects]
    items += [(coal_geometry(one), robot.link_pose(q, one.link) @ one.pose) for one in held]
    for shape, pose in items:
        low, high = _box_at(shape, pose) + [[-margin], [margin]]
        near = np.flatnonzero(((cloud >= low) & (cloud <= high)).all(axis=1))
        if len(near):
            apart = signed_distances(shape, (cloud[near] - pose[:3, 3]) @ pose[:3, :3], margin + NEARLY)
            cloud = np.delete(cloud, near[apart <= margin], axis=0)
    return cloud


def _box_at(shape: coal.CollisionGeometry, pose: Array) -> Array:
    """Return the axis-aligned box around a solid at a pose, shape (2, 3) [m]."""
    shape.computeLocalAABB()
    low, high = np.array(shape.aabb_local.min_), np.array(shape.aabb_local.max_)
    middle = pose[:3, :3] @ (low + high) / 2.0 + pose[:3, 3]
    reach = np.abs(pose[:3, :3]) @ (high - low) / 2.0
    return np.stack([middle - reach, middle + reach])


def signed_distances(shape: coal.CollisionGeometry, points: Array, limit: float) -> Array:
    """Return the signed distances of points to a solid in its frame, at most ``limit``, shape (N,) [m].

    Args:
        shape: The solid.
        points: Shape (N, 3) [m].
        limit: Largest distance of interest [m].
    """
    if not is_shell(shape):
        return np.minimum(limit, _primitive_distances(shape, points))
    tree, points = _surface(shape), np.ascontiguousarray(points)
    arrays = np.ascontiguousarray(tree.corners), tree.balls, tree.child, tree.leaf, np.empty(STACK, np.int64)
    distances = np.empty(len(points))
    surface_distances(points, *arrays, limit, distances)
    inside = _within(EnclosingMesh.of(shape), points)
    deep = np.empty(len(inside))
    surface_distances(np.ascontiguousarray(points[inside]), *arrays, np.inf, deep)
    distances[inside] = -deep
    return distances


def _within(mesh: EnclosingMesh, points: Array) -> Indices:
    """Return the indices of the points that are inside of a mesh."""
    normals, offsets = hull_planes(mesh.hull)
    some = np.flatnonzero(((points >= mesh.box[0]) & (points <= mesh.box[1])).all(axis=1))
    some = some[(points[some] @ normals.T <= offsets).all(axis=1)]
    return np.array([k for k in some if mesh.contains(points[k])], np.int64)


@weakly_cached
def _surface(shape: coal.BVHModelBase) -> Mesh:
    """Return the triangles of a mesh under a tree, also of one that is convex."""
    mesh = mesh_of(shape)
    if len(mesh.leaf):
        return mesh
    vertices, faces = triangles(shape)
    return Mesh(mesh.points, vertices[faces], *ball_tree(vertices[faces]))


def _primitive_distances(shape: coal.CollisionGeometry, points: Array) -> Array:
    """Return the signed distances of points to a primitive in its frame, shape (N,) [m]."""
    kind = shape.getNodeType()
    if kind == coal.GEOM_BOX:
        beyond = np.abs(points) - np.array(shape.halfSide)
        return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))
    if kind == coal.GEOM_SPHERE:
        return np.asarray(np.linalg.norm(points, axis=1) - shape.radius)
    across, along = np.linalg.norm(points[:, :2], axis=1), np.abs(points[:, 2])
    if kind == coal.GEOM_CAPSULE:
        return np.asarray(np.hypot(across, np.maximum(along - shape.halfLength, 0.0)) - shape.radius)
    if kind == coal.GEOM_CYLINDER:
        beyond = np.stack([across - shape.radius, along - shape.halfLength], axis=1)
        return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0))
    normals, offsets = hull_planes(shape)  # of a convex body: exact inside, a lower bound outside
    return np.asarray((points @ normals.T - offsets).max(axis=1))
