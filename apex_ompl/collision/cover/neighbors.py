"""Links with one joint between them that need no check: apart over its range, or in contact as bearings are."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.shapes import is_shell, mesh_geometry
from apex_ompl.robot.config import read_disabled_pairs_file
from apex_ompl.robot.model import Robot
from apex_ompl.robot.self_collision import SelfCollision, are_neighbors
from apex_ompl.scene.meshes import triangles, weld
from apex_ompl.types import Array

Pair = tuple[int, int]

FINEST = 1e-4  # distance below which no proof is tried [m]
MOST_INTERVALS = 4000  # of the range of a joint
SWEEP = 1001  # values of a joint at which contacts are looked for
GRAZING = "adjacent, contacts shallower than"  # beginning of the reason of pairs that do touch

Links = tuple[str, str]


def grazing_links(file: Path | None) -> tuple[Links, ...]:
    """Return the pairs of links in a file of disabled pairs that touch as bearings do; none without a file.

    Raises:
        MissingFileError: It cannot be read.
        FileFormatError: It does not follow the schema.
    """
    pairs = () if file is None else read_disabled_pairs_file(file).pairs
    return tuple(pair.links for pair in pairs if pair.reason.startswith(GRAZING))


def reason_of_neighbors(robot: Robot, pair: Pair, graze: float) -> str:
    """Return why a pair of geometries with one planned joint between them is not checked, or an empty string.

    It is proved apart over the range of the joint; or, at ``SWEEP`` values over it, it is free, or would be if the
    surfaces of both meshes were half of ``graze`` [m] further inside. Such contacts are those of bearings, not of
    motions.
    """
    joint = _joint_between(robot, pair)
    if not joint:
        return ""
    if apart_over(robot, pair):
        return f"never, proved over the range of {joint}"
    k = robot.joint_names.index(joint)
    states = np.repeat(robot.home[None], SWEEP, axis=0)
    lower, upper = robot.range_around()
    states[:, k] = np.linspace(lower[k], upper[k], SWEEP)
    if not SelfCollision(robot, [pair]).hits(states).any():
        return f"never, at {SWEEP} values over the range of {joint}"
    items = [robot.geometry.geometryObjects[geometry].geometry for geometry in pair]
    if not graze or not all(is_shell(shape) for shape in items):
        return ""
    inner = {geometry: taken_in(shape, graze / 2.0) for geometry, shape in zip(pair, items, strict=True)}
    if SelfCollision(robot, [pair], inner).hits(states).any():
        return ""
    return f"{GRAZING} {1e3 * graze:g} mm at {SWEEP} values over the range of {joint}"


def taken_in(mesh: coal.BVHModelBase, depth: float) -> coal.BVHModelBase:
    """Return a mesh whose corners are moved inside along their normals [m]."""
    vertices, faces = triangles(mesh)
    corners = vertices[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volume = float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])))
    place = weld(vertices)
    normals = np.zeros((int(place.max()) + 1, 3))
    for corner in range(3):
        np.add.at(normals, place[faces[:, corner]], areas)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
    inside: Array = vertices - np.sign(volume) * depth * normals[place]
    return mesh_geometry(inside, faces)


def _joint_between(robot: Robot, pair: Pair) -> str:
    """Return the planned joint that is the only one between two geometries, or an empty string."""
    joints = [robot.geometry.geometryObjects[k].parentJoint for k in pair]
    if not are_neighbors(robot, pair):
        return ""
    name = str(robot.model.names[joints[1] if robot.model.parents[joints[1]] == joints[0] else joints[0]])
    return name if name in robot.joint_names else ""  # others mimic one


def apart_over(robot: Robot, pair: Pair) -> str:
    """Return the joint over whose whole range a pair of geometries is proved apart, or an empty string.

    The pair has this joint alone between them. A joint that moves by x moves no point of a body by more than r x,
    where r is the largest distance of its points from the axis (or 1, for a prismatic joint). So where a distance
    exceeds r times half the width of an interval around it, the pair is apart over all of it; other intervals are
    halved.
    """
    model = robot.model
    name = _joint_between(robot, pair)
    if not name:
        return ""
    joints = [robot.geometry.geometryObjects[k].parentJoint for k in pair]
    k, moved = robot.joint_names.index(name), model.getJointId(name)
    item = robot.geometry.geometryObjects[pair[joints.index(moved)]]
    reach = 1.0 if "P" in model.joints[moved].shortname() else _reach(item)
    alone = SelfCollision(robot, [pair])
    lower, upper = robot.range_around()
    intervals = [(float(lower[k]), float(upper[k]))]
    for low, high in intervals:
        q = robot.home.copy()
        q[k] = 0.5 * (low + high)
        distance = float(alone.distances(q)[0])
        if distance > 0.5 * (high - low) * reach + FINEST:
            continue
        if distance < 2.0 * FINEST or len(intervals) > MOST_INTERVALS:
            return ""
        intervals += [(low, q[k]), (q[k], high)]
    return str(robot.joint_names[k])


def _reach(item: pin.GeometryObject) -> float:
    """Return a bound on the distances of a geometry's points from its joint's axis, by those from its origin [m]."""
    item.geometry.computeLocalAABB()
    middle = item.placement.act(np.array(item.geometry.aabb_center))
    return float(np.linalg.norm(middle) + item.geometry.aabb_radius)
