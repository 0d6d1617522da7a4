"""From Pinocchio's and Coal's objects to the kernel's tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from apex_ompl.collision.sphere_proof import Cover
from apex_ompl.errors import RobotError
from apex_ompl.kernel.build import BodySpec, JointSpec, robot_tables
from apex_ompl.kernel.tables import (
    BOX,
    CAPSULE,
    CYLINDER,
    HALF_SPACE,
    PRISMATIC,
    REVOLUTE,
    SPHERE,
    Primitive,
    RobotTables,
    SceneTables,
    scene_tables,
)  # fmt: skip
from apex_ompl.meshes import bounding_boxes, triangles
from apex_ompl.robot import Robot

Array = NDArray[np.float64]

PROBE = 0.5  # value of a planned joint at which the motion of the others is read off [rad]


def joint_specs(robot: Robot) -> list[JointSpec]:
    """Return the joints of a robot's Pinocchio model, which keep their numbers.

    Axes and mimic ratios are read off the motion of each joint, so that every kind of revolute, prismatic or mimic
    joint is known.

    Raises:
        RobotError: A joint moves in another way.
    """
    model, data = robot.model, robot.model.createData()
    specs = [JointSpec(0)]
    zero = np.zeros(model.nq)
    pin.forwardKinematics(model, data, zero)
    rest = [data.liMi[k].copy() for k in range(model.njoints)]
    source = [int(k) for k in robot.to_pinocchio(np.arange(float(robot.dof)))]  # by place in Pinocchio's order
    moved: dict[int, list[pin.SE3]] = {}
    for p in range(model.nq):
        for scale in (1.0, -2.0):
            pin.forwardKinematics(model, data, zero + scale * PROBE * np.eye(model.nq)[p])
            moved.setdefault(p, []).extend(data.liMi[k].copy() for k in range(model.njoints))
    for k in range(1, model.njoints):
        parent, place = int(model.parents[k]), rest[k].homogeneous
        p = int(model.joints[k].idx_q)
        motion = pin.log6(rest[k].actInv(moved[p][k])).vector / PROBE
        again = pin.exp6(pin.Motion(-2.0 * PROBE * motion))
        speed, turn = np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])
        if not rest[k].actInv(moved[p][model.njoints + k]).isApprox(again, 1e-9) or min(speed, turn) > 1e-12:
            raise RobotError(f"joint {model.names[k]!r} is neither revolute nor prismatic, which the kernel needs")
        kind, along = (REVOLUTE, motion[3:]) if turn > 0.0 else (PRISMATIC, motion[:3])
        ratio = float(np.linalg.norm(along))
        axis = along / ratio if ratio > 0.0 else np.array([0.0, 0.0, 1.0])
        specs.append(JointSpec(parent, kind, place, axis, source[p], ratio))
    return specs


def tabulate(
    robot: Robot,
    *,
    items: Sequence[pin.GeometryObject],
    numbers: Sequence[int],
    covers: Sequence[Cover],
    meets_scene: Sequence[bool],
    pairs: Iterable[tuple[int, int]],
) -> RobotTables:
    """Return the tables of a robot with all that hangs on it.

    Args:
        robot: The robot.
        items: Its geometries and those of what it holds.
        numbers: What each goes by outside of the tables.
        covers: The cover of each.
        meets_scene: Whether each is judged against obstacles.
        pairs: Those that may not touch, by their places in ``items``.
    """
    bodies = [
        BodySpec(
            item.name, int(item.parentJoint), item.placement.homogeneous, cover.centres, cover.radii, cover.first,
            cover.count, meets,
        )
        for item, cover, meets in zip(items, covers, meets_scene, strict=True)
    ]  # fmt: skip
    limits = robot.limits
    return robot_tables(
        robot.name, robot.joint_names, lower=limits.lower, upper=limits.upper, joints=joint_specs(robot),
        bodies=bodies, pairs=list(pairs), numbers=numbers,
    )  # fmt: skip


def tabulate_scene(obstacles: Mapping[int, tuple[coal.CollisionGeometry, Array]]) -> SceneTables:
    """Return the tables of obstacles by number, each a geometry and its pose in the world, shape (4, 4)."""
    return scene_tables([(n, p) for n, (shape, pose) in obstacles.items() for p in primitives(shape, pose)])


def primitives(shape: coal.CollisionGeometry, pose: Array) -> list[Primitive]:
    """Return solids that the kernel knows and that contain a geometry: itself, or boxes around a mesh."""
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
    found = []
    for low, high in bounding_boxes(*triangles(shape)):
        centre = np.eye(4)
        centre[:3, 3] = (low + high) / 2.0
        found.append(Primitive(BOX, pose @ centre, tuple((high - low) / 2.0)))
    return found
