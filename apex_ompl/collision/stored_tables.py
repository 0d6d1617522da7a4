"""Tables and exact shapes of a robot with what it holds, kept in the user's cache between processes.

They are named after a digest of all that they are made of: the joints, the content of the shapes, their places, covers
and pairs, and the code that makes them. A file that is missing, damaged or of something else costs the time that it
takes to make them, and no cache is needed. Only the first tables of a robot in a process are kept: a program that
attaches objects all the time would fill the cache with the others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.clouds import cloud_of
from apex_ompl.collision.cover.spheres import shape_key
from apex_ompl.collision.exact_shapes import PlacedShape, shape_arrays
from apex_ompl.collision.robot_covers import covers_of
from apex_ompl.collision.shapes import is_shell
from apex_ompl.collision.solids import Solid
from apex_ompl.collision.tabulate import tabulate
from apex_ompl.kernel.arrays import RobotArrays, ShapeArrays, pack, unpack
from apex_ompl.kernel.tables import RobotTables
from apex_ompl.robot import Robot
from apex_ompl.scene.meshes import triangles
from apex_ompl.util.cache import stored
from apex_ompl.util.files import read_file
from apex_ompl.util.weak_cache import weakly_cached

FOLDER = "robots"
PACKAGES = ("collision", "kernel", "robot", "scene", "util")  # whose code makes tables

R = TypeVar("R")


def make_tables(
    robot: Robot, solids: Sequence[Solid], meets_scene: Sequence[bool], pairs: Sequence[tuple[int, int]]
) -> RobotTables:
    """Return the tables of a robot with its links and held objects, whose numbers are their places.

    Args:
        robot: The robot.
        solids: Its links and what it holds.
        meets_scene: Whether each is checked against obstacles.
        pairs: Pairs that are checked for self-collision, by their places in ``solids``.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
        RobotError: A joint moves in a way that the kernel does not know.
    """
    covers = covers_of(robot, [solid.shape for solid in solids])
    return tabulate(
        robot, solids=solids, numbers=range(len(solids)), covers=covers, meets_scene=meets_scene, pairs=pairs
    )


def stored_tables(
    robot: Robot, solids: Sequence[Solid], meets_scene: Sequence[bool], pairs: Sequence[tuple[int, int]]
) -> RobotTables:
    """Return the tables of :func:`make_tables`, from the cache where it has them.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
        RobotError: A joint moves in a way that the kernel does not know.
    """
    limits = robot.limits
    parts = [
        robot.urdf.encode(), robot.to_pinocchio(np.arange(float(robot.dof))).tobytes(), limits.lower.tobytes(),
        limits.upper.tobytes(), b"" if robot.covers is None else read_file(robot.covers, "sphere covers"),
        *(_of_shape(s.shape, s.joint, s.placement.homogeneous, s.part or s.name) for s in solids),
        repr((robot.name, robot.joint_names, list(meets_scene), list(pairs))).encode(),
    ]  # fmt: skip

    def make() -> tuple[dict[str, Any], RobotArrays]:
        tables = make_tables(robot, solids, meets_scene, pairs)
        return {"bodies": tables.body_names, "numbers": tables.numbers}, tables.arrays

    about, arrays = _stored("tables", parts, RobotArrays, make)
    return RobotTables(robot.name, robot.joint_names, tuple(about["bodies"]), tuple(about["numbers"]), arrays)


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
    """Return what tables take from a shape that is fixed to a joint at a pose, shape (4, 4) [m]."""
    place = np.asarray(pose, float).tobytes()
    return json.dumps([name, joint, shape_key(geometry)]).encode() + _content(geometry) + place


@weakly_cached
def _content(geometry: coal.CollisionGeometry) -> bytes:
    """Return a digest of a shape to the last bit; its key is of rounded numbers."""
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


@cache
def _code() -> bytes:
    """Return a digest of the code that makes tables."""
    digest = hashlib.sha256(repr((np.__version__, coal.__version__, pin.__version__)).encode())
    root = Path(__file__).parent.parent
    for package in PACKAGES:
        for file in sorted((root / package).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.digest()
