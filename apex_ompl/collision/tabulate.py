"""The kernel's tables from Pinocchio models and Coal shapes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.clouds import cloud_of
from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.cover.boxes import bounding_boxes
from apex_ompl.collision.cover.proof import Cover
from apex_ompl.collision.inner_balls import inner_balls
from apex_ompl.collision.shapes import is_surface
from apex_ompl.collision.solids import Solid
from apex_ompl.errors import RobotError
from apex_ompl.kernel.arrays import BOX, CAPSULE, CYLINDER, GRID, HALF_SPACE, PRISMATIC, REVOLUTE, SPHERE
from apex_ompl.kernel.distance_grid import grid_of_points, grid_of_triangles
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.kernel.robot_builder import robot_tables
from apex_ompl.kernel.robot_specs import BodySpec, JointSpec, no_balls
from apex_ompl.kernel.scene_builder import Primitive
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.robot import Robot
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array
from apex_ompl.util.arrays import length
from apex_ompl.util.weak_cache import weakly_cached

PROBE = 1e-3  # value of a planned joint at which axes and ratios are measured: no joint turns by half a turn or more
CHECKS = (0.37, -1.13, 2.71)  # values at which they are checked, besides the limits


@weakly_cached
def joint_tree(robot: Robot) -> JointTree:
    """Return the tree of a robot's joints, made once for a robot.

    Raises:
        RobotError: The motion of a joint is not that of a constant twist about or along an axis.
    """
    return JointTree(joint_specs(robot))


def joint_specs(robot: Robot) -> list[JointSpec]:
    """Return the joints of a robot's Pinocchio model, which keep their numbers.

    Axes and mimic ratios are measured: they are the twist of each joint, log(T(0)^-1 T(q)) / q, which holds for every
    kind of revolute, prismatic or mimic joint.

    Raises:
        RobotError: The motion of a joint is not that of a constant twist about or along an axis.
    """
    model, data = robot.model, robot.model.createData()
    source = [int(k) for k in robot.to_pinocchio(np.arange(float(robot.dof)))]  # by place in Pinocchio's order

    def placements(p: int, value: float) -> list[pin.SE3]:
        q = np.zeros(model.nq)
        q[p] = value
        pin.forwardKinematics(model, data, q)
        return [placement.copy() for placement in data.liMi]

    rest = placements(0, 0.0)
    specs = {0: JointSpec(0)}
    for p in range(model.nq):
        probe = placements(p, PROBE)
        limits = float(robot.limits.lower[source[p]]), float(robot.limits.upper[source[p]])
        checks = [(value, placements(p, value)) for value in (*CHECKS, *limits)]
        for k in (k for k in range(1, model.njoints) if model.joints[k].idx_q == p):
            motion = pin.log6(rest[k].actInv(probe[k])).vector / PROBE
            speed, turn = length(motion[:3]), length(motion[3:])
            same = (
                rest[k].actInv(there[k]).isApprox(pin.exp6(pin.Motion(value * motion)), 1e-6) for value, there in checks
            )
            if min(speed, turn) > 1e-9 or not all(same):
                raise RobotError(f"joint {model.names[k]!r} is neither revolute nor prismatic, which the kernel needs")
            kind, along = (REVOLUTE, motion[3:]) if turn > speed else (PRISMATIC, motion[:3])
            ratio = length(along)
            axis = along / ratio if ratio > 1e-9 else np.array([0.0, 0.0, 1.0])
            place = rest[k].homogeneous
            specs[k] = JointSpec(int(model.parents[k]), kind, place, axis, source[p], ratio)
    return [specs[k] for k in range(model.njoints)]


def tabulate(
    robot: Robot,
    *,
    solids: Sequence[Solid],
    numbers: Sequence[int],
    covers: Sequence[Cover],
    meets_scene: Sequence[bool],
    pairs: Iterable[tuple[int, int]],
) -> RobotTables:
    """Return the tables of a robot with its links and held objects.

    Args:
        robot: The robot.
        solids: Its links and what it holds.
        numbers: Number of each outside of the tables.
        covers: The cover of each.
        meets_scene: Whether each is checked against obstacles.
        pairs: Pairs that are checked for self-collision, by their places in ``solids``.
    """
    bodies = [
        BodySpec(
            solid.part or solid.name, solid.joint, solid.placement.homogeneous, cover.centers, cover.radii,
            cover.first, cover.count, inner_balls(solid.shape) if meets else no_balls(), meets,
        )
        for solid, cover, meets in zip(solids, covers, meets_scene, strict=True)
    ]  # fmt: skip
    limits = robot.limits
    return robot_tables(
        robot.name, robot.joint_names, lower=limits.lower, upper=limits.upper, tree=joint_tree(robot),
        bodies=bodies, pairs=list(pairs), numbers=numbers,
    )  # fmt: skip


def primitives(shape: coal.CollisionGeometry, pose: Array) -> list[Primitive]:
    """Return primitives that together contain a geometry: itself, or a grid of distances to a mesh or to points.

    Args:
        shape: The geometry.
        pose: Its pose in the world, shape (4, 4) [m].
    """
    kind = shape.getNodeType()
    if kind == coal.GEOM_BOX:
        return [Primitive(BOX, pose, tuple(shape.halfSide))]
    if kind == coal.GEOM_SPHERE:
        return [Primitive(SPHERE, pose, (shape.radius,))]
    if kind == coal.GEOM_CYLINDER:
        return [Primitive(CYLINDER, pose, (shape.radius, shape.halfLength))]
    if kind == coal.GEOM_CAPSULE:
        return [Primitive(CAPSULE, pose, (shape.radius, shape.halfLength))]
    if kind == coal.GEOM_HALFSPACE:
        normal = pose[:3, :3] @ shape.n
        return [Primitive(HALF_SPACE, pose, (*normal, shape.d + float(normal @ pose[:3, 3])))]
    cloud = cloud_of(shape)
    if cloud is not None:
        return [Primitive(GRID, pose, (), grid_of_points(cloud.points, cloud.radius))]
    if is_surface(shape):
        vertices, faces = triangles(shape)
        return [Primitive(GRID, pose, (), grid_of_triangles(vertices[faces], solid=False))]
    mesh = EnclosingMesh.of(shape)
    if mesh.watertight:
        return [Primitive(GRID, pose, (), grid_of_triangles(mesh.corners, solid=True), exact=mesh.closed)]
    found = []
    for low, high in bounding_boxes(mesh.boundary):
        center = np.eye(4)
        center[:3, 3] = (low + high) / 2.0
        found.append(Primitive(BOX, pose @ center, tuple((high - low) / 2.0), exact=False))
    return found
