"""Contact of solids with point clouds: distances of points from boxes, round bodies and the triangles of meshes."""

from __future__ import annotations

from collections.abc import Iterable

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.exact_shapes import PlacedShape, mesh_of
from apex_ompl.collision.hulls import hull_planes
from apex_ompl.collision.shapes import PointCloud, cloud_of, coal_geometry, is_shell, is_surface
from apex_ompl.collision.solids import Solid, world_boxes
from apex_ompl.kernel.geometry import (
    BallTree,
    any_inside,
    near_mesh,
    near_primitive,
    primitive_distances,
    surface_distances,
    tree_order,
)
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array, Flags, Indices
from apex_ompl.util.cache import weakly_cached
from apex_ompl.util.validation import check_array, check_number, finite_array

SOME = 10_000  # points
LARGEST_MARGIN = 1.0  # [m]
NEARLY = 1e-6  # beyond a limit [m]


def touches(cloud_shape: coal.CollisionGeometry, shape: coal.CollisionGeometry, pose: pin.SE3) -> bool:
    """Whether a solid reaches into the balls of a cloud.

    Args:
        cloud_shape: The geometry that stands for the cloud.
        shape: The solid.
        pose: Its pose in the cloud's frame [m].
    """
    cloud, at = mesh_of(cloud_shape), np.ascontiguousarray(pose.homogeneous)
    if not is_shell(shape):
        return near_primitive(cloud.tree, *_primitive(shape), at, cloud.radius)
    if near_mesh(cloud.tree, _surface(shape), at, cloud.radius):
        return True
    return not is_surface(shape) and any_inside(cloud.tree, EnclosingMesh.of(shape).surface, _planes(shape), at)


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
    return cloud[~on_robot(cloud, robot, state, margin, held)]


def on_robot(
    points: ArrayLike, robot: Robot, state: ArrayLike, margin: float = 0.02, held: Iterable[AttachedObject] = ()
) -> Flags:
    """Return which points :func:`filter_points` leaves out, whose arguments it has, shape (N,)."""
    cloud = finite_array(points, "points")
    check_array(cloud, (len(cloud), 3) if cloud.ndim else (0, 3), "points")
    q = finite_array(state, "state")
    check_array(q, (robot.dof,), "state")
    check_number(margin, "margin", 0.0, LARGEST_MARGIN)
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
    items = [(item.geometry, data.oMi[item.parentJoint] * item.placement) for item in robot.geometry.geometryObjects]
    items += [(coal_geometry(one), pin.SE3(robot.link_pose(q, one.link) @ one.pose)) for one in held]
    left = np.arange(len(cloud))
    for shape, pose in items:
        left = left[_distances(cloud[left], Solid("", 0, pose, shape), pose, margin + NEARLY) > margin]
    found = np.ones(len(cloud), bool)
    found[left] = False
    return found


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
    points = np.ascontiguousarray(points)
    if not is_shell(shape):
        return np.minimum(limit, primitive_distances(points, *_primitive(shape)))
    tree = _surface(shape)
    distances = surface_distances(points, tree, limit)
    if not is_surface(shape):
        inside = _within(shape, points)
        distances[inside] = -surface_distances(np.ascontiguousarray(points[inside]), tree, np.inf)
    return distances


def _within(shape: coal.BVHModelBase, points: Array) -> Indices:
    """Return the indices of the points that are inside of a mesh."""
    mesh, (normals, offsets) = EnclosingMesh.of(shape), _planes(shape)
    some = np.flatnonzero(((points >= mesh.box[0]) & (points <= mesh.box[1])).all(axis=1))
    some = some[(points[some] @ normals.T <= offsets).all(axis=1)]
    return np.array([k for k in some if mesh.contains(points[k])], np.int64)


@weakly_cached
def _surface(shape: coal.BVHModelBase) -> BallTree:
    """Return the triangles of a mesh under a tree, also of one that is convex."""
    tree = mesh_of(shape).tree
    if len(tree.leaf):
        return tree
    vertices, faces = triangles(shape)
    corners = vertices[faces]
    return BallTree.over(corners[tree_order(corners.mean(axis=1))])


def _primitive(shape: coal.CollisionGeometry) -> tuple[int, Array]:
    """Return kind and size of a primitive for the kernel."""
    solid = PlacedShape(shape, 0, np.eye(4))
    return solid.kind, np.array(solid.row[2], float)
