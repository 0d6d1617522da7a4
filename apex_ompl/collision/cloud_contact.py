"""Contact of solids with point clouds: distances of points from boxes, round bodies and the triangles of meshes."""

from __future__ import annotations

from collections.abc import Iterable

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.exact_shapes import Mesh, PlacedShape, ball_tree, mesh_of, tree_order
from apex_ompl.collision.hulls import hull_planes
from apex_ompl.collision.shapes import PointCloud, cloud_of, coal_geometry, is_shell, is_surface
from apex_ompl.collision.solids import Solid, world_boxes
from apex_ompl.kernel.compiled.cloud_distance import any_inside, near_mesh, near_primitive, primitive_distances
from apex_ompl.kernel.compiled.triangle_distance import surface_distances
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array, Indices
from apex_ompl.util.cache import weakly_cached
from apex_ompl.util.validation import check_array, check_number, finite_array

SOME = 10_000  # points
STACK = 128  # nodes that wait in a walk down a tree
LARGEST_MARGIN = 1.0  # [m]
NEARLY = 1e-6  # beyond a limit [m]


def touches(cloud_shape: coal.CollisionGeometry, shape: coal.CollisionGeometry, pose: pin.SE3) -> bool:
    """Whether a solid reaches into the balls of a cloud.

    Args:
        cloud_shape: The geometry that stands for the cloud.
        shape: The solid.
        pose: Its pose in the cloud's frame [m].
    """
    tree, at, stack = mesh_of(cloud_shape), np.ascontiguousarray(pose.homogeneous), np.empty((STACK, 2), np.int64)
    points = tree.corners, tree.balls, tree.child, tree.leaf
    boxed = tree.corners, tree.balls, tree.halves, tree.child, tree.leaf
    if not is_shell(shape):
        return bool(near_primitive(*points, *_primitive(shape), at, tree.radius, stack))
    own = _surface(shape)
    surface = own.corners, own.balls, own.halves, own.child, own.leaf
    if near_mesh(*boxed, *surface, at, tree.radius, stack):
        return True
    if is_surface(shape):
        return False
    outer = EnclosingMesh.of(shape)
    return bool(any_inside(*points, outer.corners, outer.box, outer.watertight, *_planes(shape), at, stack))


def nearest_balls(solid: Solid, boxes: Array) -> list[Solid]:
    """Return a solid, or of a cloud the balls that are nearest to boxes in the world, shape (n, 2, 3) [m].

    Large clouds are subsampled.
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


def cloud_depth(cloud: PointCloud, solid: Solid, pose: pin.SE3) -> float:
    """Return how deep a solid at a pose in a cloud's frame reaches into its balls, negative where it does not [m].

    It is the depth of the deepest ball.
    """
    return cloud.radius - float(_distances(cloud.points, solid, pose, cloud.radius + NEARLY).min())


def filter_points(
    points: ArrayLike, robot: Robot, state: ArrayLike, margin: float = 0.02, held: Iterable[AttachedObject] = ()
) -> Array:
    """Return the points that are not on the robot or its held objects, shape (n, 3) [m].

    Args:
        points: Points in the world, shape (N, 3) [m].
        robot: The robot.
        state: Its state, shape (dof,).
        margin: Distance up to which a point counts as part of the robot or a held object [m].
        held: Held objects.

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
    items = [(item.geometry, data.oMi[item.parentJoint] * item.placement) for item in robot.geometry.geometryObjects]
    items += [(coal_geometry(one), pin.SE3(robot.link_pose(q, one.link) @ one.pose)) for one in held]
    for shape, pose in items:
        cloud = cloud[_distances(cloud, Solid("", 0, pose, shape), pose, margin + NEARLY) > margin]
    return cloud


def _distances(points: Array, solid: Solid, pose: pin.SE3, limit: float) -> Array:
    """Return the signed distances of points to a solid at a pose in their frame, at most ``limit``, shape (N,) [m]."""
    low, high = world_boxes([solid], [pose])[0]
    near = ((points >= low - limit) & (points <= high + limit)).all(axis=1)
    found = np.full(len(points), limit)
    found[near] = signed_distances(solid.shape, (points[near] - pose.translation) @ pose.rotation, limit)
    return found


def signed_distances(shape: coal.CollisionGeometry, points: Array, limit: float) -> Array:
    """Return the signed distances of points to a solid in its frame, at most ``limit``, shape (N,) [m].

    Args:
        shape: The solid.
        points: Shape (N, 3) [m].
        limit: Largest distance of interest [m].
    """
    points, distances = np.ascontiguousarray(points), np.empty(len(points))
    if not is_shell(shape):
        primitive_distances(points, *_primitive(shape), distances)
        return np.minimum(limit, distances)
    tree = _surface(shape)
    arrays = np.ascontiguousarray(tree.corners), tree.balls, tree.child, tree.leaf, np.empty(STACK, np.int64)
    surface_distances(points, *arrays, limit, distances)
    if is_surface(shape):
        return distances
    inside = _within(shape, points)
    deep = np.empty(len(inside))
    surface_distances(np.ascontiguousarray(points[inside]), *arrays, np.inf, deep)
    distances[inside] = -deep
    return distances


def _within(shape: coal.BVHModelBase, points: Array) -> Indices:
    """Return the indices of the points that are inside of a mesh."""
    mesh, (normals, offsets) = EnclosingMesh.of(shape), _planes(shape)
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
    corners = vertices[faces]
    corners = corners[tree_order(corners.mean(axis=1))]
    return Mesh(mesh.points, corners, *ball_tree(corners))


def _primitive(shape: coal.CollisionGeometry) -> tuple[int, Array]:
    """Return kind and size of a primitive for the kernel."""
    solid = PlacedShape(shape, 0, np.eye(4))
    return solid.kind, np.array(solid.row[2], float)
