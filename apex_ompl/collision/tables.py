"""The kernel's tables of a robot with its held objects, made from Pinocchio models and Coal shapes, and their cache.

Tables are kept in the user's cache between processes. A file is named after a digest of all inputs: the joints, the
content of the shapes, their poses, covers and pairs, and the code that makes tables. A file that is missing or damaged
is made anew, and no cache is needed. Only the first tables of a robot in a process are kept: a program that attaches
objects all the time would fill the cache.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.clearance_tables import clearance_digests, clearances_of
from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.cover.proof import Cover
from apex_ompl.collision.cover.quick import bounding_boxes, covers_of
from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.exact_shapes import PlacedShape, shape_arrays, shape_digest
from apex_ompl.collision.inner_balls import inner_balls
from apex_ompl.collision.shapes import cloud_of, is_surface
from apex_ompl.collision.solids import Solid
from apex_ompl.errors import RobotError
from apex_ompl.kernel.arrays import (
    BOX,
    CAPSULE,
    CYLINDER,
    GRID,
    HALF_SPACE,
    PRISMATIC,
    REVOLUTE,
    SPHERE,
    RobotArrays,
    ShapeArrays,
    pack,
    unpack,
)
from apex_ompl.kernel.clearance_table import ClearanceTable
from apex_ompl.kernel.distance_grid import grid_of_points, grid_of_triangles
from apex_ompl.kernel.joint_tree import JointTree
from apex_ompl.kernel.robot_builder import robot_tables
from apex_ompl.kernel.scene_builder import Primitive
from apex_ompl.kernel.tables import BodySpec, JointSpec, RobotTables, no_balls
from apex_ompl.robot import Robot
from apex_ompl.scene.meshes import triangles
from apex_ompl.types import Array
from apex_ompl.util.arrays import length
from apex_ompl.util.cache import kept, stored, weakly_cached
from apex_ompl.util.files import read_file

PROBE = 1e-3  # value of a planned joint at which axes and ratios are measured: no joint turns by half a turn or more
CHECKS = (0.37, -1.13, 2.71)  # values at which they are checked, besides the limits
FOLDER = "robots"
PACKAGES = ("collision", "kernel", "robot", "scene", "util")  # whose code makes tables
MOST_ROBOTS = 16  # whose balls are kept
R = TypeVar("R")

_inner: dict[str, list[Array]] = {}  # balls inside of the links of robots, by a digest of their shapes


@weakly_cached
def joint_tree(robot: Robot) -> JointTree:
    """Return the tree of a robot's joints, made once for a robot.

    Raises:
        RobotError: The motion of a joint is not that of a constant twist about or along an axis.
    """
    return JointTree(joint_specs(robot), np.flatnonzero(robot.continuous).tolist())


def with_range(robot: Robot, lower: Array, upper: Array) -> Robot:
    """Return a robot with other positions of limits, shape (dof,) each, which shares its tree of joints."""
    other = replace(robot, limits=replace(robot.limits, lower=lower, upper=upper))
    joint_tree.keep(other, joint_tree(robot))
    return other


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
    inner: Sequence[Array],
    meets_scene: Sequence[bool],
    pairs: Iterable[tuple[int, int]],
    clearances: Mapping[tuple[int, int], ClearanceTable] | None = None,
) -> RobotTables:
    """Return the tables of a robot with its links and held objects.

    Args:
        robot: The robot.
        solids: Its links and held objects.
        numbers: Number of each outside of the tables.
        covers: The cover of each.
        inner: Centers and radii of balls inside of each, shape (k, 4) [m].
        meets_scene: Whether each is checked against obstacles.
        pairs: Pairs that are checked for self-collision, by their places in ``solids``.
        clearances: Tables of clearances of some of them.
    """
    bodies = [
        BodySpec(
            solid.part or solid.name, solid.joint, solid.placement.homogeneous, cover.centers, cover.radii,
            cover.first, cover.count, balls if meets else no_balls(), meets,
        )
        for solid, cover, balls, meets in zip(solids, covers, inner, meets_scene, strict=True)
    ]  # fmt: skip
    limits = robot.limits
    return robot_tables(
        robot.name, robot.joint_names, lower=limits.lower, upper=limits.upper, tree=joint_tree(robot),
        bodies=bodies, pairs=list(pairs), numbers=numbers, clearances=clearances, weights=robot.weights,
        continuous=robot.continuous,
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


def make_tables(
    robot: Robot, solids: Sequence[Solid], meets_scene: Sequence[bool], pairs: Sequence[tuple[int, int]]
) -> RobotTables:
    """Return the tables of a robot with its links and held objects, whose numbers are their places.

    Args:
        robot: The robot.
        solids: Its links and held objects.
        meets_scene: Whether each is checked against obstacles.
        pairs: Pairs that are checked for self-collision, by their places in ``solids``.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file, or that of clearance tables, does not follow its schema.
        RobotError: The kernel does not support the motion of a joint.
    """
    shapes = [solid.shape for solid in solids]
    links = len(robot.geometry.geometryObjects)
    inner = [*stored_inner_balls(shapes[:links]), *map(inner_balls, shapes[links:])]
    return tabulate(
        robot, solids=solids, numbers=range(len(solids)), covers=covers_of(robot, shapes), inner=inner,
        meets_scene=meets_scene, pairs=pairs,
        clearances=clearances_of(robot, joint_tree(robot), solids, pairs),
    )  # fmt: skip


def stored_tables(
    robot: Robot, solids: Sequence[Solid], meets_scene: Sequence[bool], pairs: Sequence[tuple[int, int]]
) -> RobotTables:
    """Return the tables of :func:`make_tables`, from the cache where it has them.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file, or that of clearance tables, does not follow its schema.
        RobotError: The kernel does not support the motion of a joint.
    """
    limits = robot.limits
    parts = [
        robot.urdf.encode(), robot.to_pinocchio(np.arange(float(robot.dof))).tobytes(), limits.lower.tobytes(),
        limits.upper.tobytes(), robot.weights.tobytes(), robot.continuous.tobytes(),
        b"" if robot.covers is None else read_file(robot.covers, "sphere covers"),
        json.dumps(clearance_digests(robot), sort_keys=True).encode(),
        *(_of_shape(s.shape, s.joint, s.placement.homogeneous, s.part or s.name) for s in solids),
        repr((robot.name, robot.joint_names, list(meets_scene), list(pairs))).encode(),
    ]  # fmt: skip

    def make() -> tuple[dict[str, Any], RobotArrays]:
        tables = make_tables(robot, solids, meets_scene, pairs)
        return {"bodies": tables.body_names, "numbers": tables.numbers}, tables.arrays

    about, arrays = _stored("tables", parts, RobotArrays, make)
    return RobotTables(robot.name, robot.joint_names, tuple(about["bodies"]), tuple(about["numbers"]), arrays)


def stored_inner_balls(shapes: Sequence[coal.CollisionGeometry]) -> list[Array]:
    """Return the balls inside of links (:func:`apex_ompl.collision.inner_balls.inner_balls`), by the cache."""
    keys = [shape_key(shape) for shape in shapes]

    def make() -> tuple[dict[str, Any], dict[str, Any]]:
        found = [inner_balls(shape) for shape in shapes]
        return {"counts": [len(balls) for balls in found]}, {"balls": np.concatenate([np.empty((0, 4)), *found])}

    def read(about: dict[str, Any], arrays: dict[str, Any]) -> list[Array]:
        ends = np.cumsum(about["counts"])
        return [arrays["balls"][end - count : end] for end, count in zip(ends, about["counts"], strict=True)]

    digest = hashlib.sha256(_code() + "".join(keys).encode()).hexdigest()[:32]
    return kept(_inner, digest, lambda: stored(FOLDER, f"inner-{digest}", make, read), MOST_ROBOTS)


def stored_shapes(placed: Sequence[PlacedShape]) -> ShapeArrays:
    """Return the kernel's arrays of shapes (:func:`apex_ompl.collision.exact_shapes.shape_arrays`), by the cache."""
    parts = [_of_shape(one.geometry, one.joint, one.pose) for one in placed]
    return _stored("shapes", parts, ShapeArrays, lambda: ({}, shape_arrays(placed)))[1]


def _stored(
    what: str, parts: Iterable[bytes], kind: Callable[..., R], make: Callable[[], tuple[dict[str, Any], R]]
) -> tuple[dict[str, Any], R]:
    digest = hashlib.sha256(_code())
    for part in parts:
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)

    def made() -> tuple[dict[str, Any], dict[str, Any]]:
        about, arrays = make()
        integers, floats = pack(arrays)
        return about, {"integers": integers, "floats": floats}

    def read(about: dict[str, Any], arrays: dict[str, Any]) -> tuple[dict[str, Any], R]:
        return about, unpack(kind, arrays["integers"], arrays["floats"])

    return stored(FOLDER, f"{what}-{digest.hexdigest()[:32]}", made, read)


def _of_shape(geometry: coal.CollisionGeometry, joint: int, pose: Any, name: str = "") -> bytes:
    """Return the content of a shape that is fixed to a joint at a pose, shape (4, 4) [m], that tables depend on."""
    place = np.asarray(pose, float).tobytes()
    return json.dumps([name, joint]).encode() + shape_digest(geometry) + place


@cache
def _code() -> bytes:
    """Return a digest of the code that makes tables."""
    digest = hashlib.sha256(repr((np.__version__, coal.__version__, pin.__version__)).encode())
    root = Path(__file__).parent.parent
    for package in PACKAGES:
        for file in sorted((root / package).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.digest()
