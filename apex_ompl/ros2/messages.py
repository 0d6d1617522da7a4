"""Conversion of messages: markers, poses, clouds and joint states to records, and records to markers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.scene.bodies import Obstacle, pose_fields, pose_matrix
from apex_ompl.scene.problem import PoseTarget
from apex_ompl.timing.files import NANOSECONDS
from apex_ompl.types import Array
from apex_ompl.util.schema import validate

CUBE, SPHERE, CYLINDER, LINE_STRIP, CUBE_LIST, SPHERE_LIST, MESH = 1, 2, 3, 4, 6, 7, 10
"""Types of ``visualization_msgs/Marker``."""
KINDS = {0: "an arrow", LINE_STRIP: "a line strip", 5: "a line list", 8: "points", 9: "a text", 11: "triangles"}
ADD, DELETE, DELETE_ALL = 0, 2, 3
"""Actions of markers."""
FLOATS = {7: "f4", 8: "f8"}
"""Types of ``sensor_msgs/PointField`` that coordinates may have."""
UNIT = 1e-3  # by which the length of a quaternion may differ from 1
MOST_POINTS = 5000  # of a marker


def nanoseconds(stamp: Any) -> int:
    """Return a ``builtin_interfaces/Time`` [ns]."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def pose_of(message: Any) -> Array:
    """Return a ``geometry_msgs/Pose`` as a matrix, shape (4, 4) [m]; a quaternion of zeros means no rotation.

    Raises:
        ParameterError: A number is not finite, or the quaternion has another length than 1.
    """
    return _matrix(message.position, message.orientation)


def transform_matrix(message: Any) -> Array:
    """Return a ``geometry_msgs/Transform`` as a matrix, shape (4, 4) [m].

    Raises:
        ParameterError: A number is not finite, or the quaternion has another length than 1.
    """
    return _matrix(message.translation, message.rotation)


def _matrix(at: Any, turn: Any) -> Array:
    position, q = np.array([at.x, at.y, at.z]), np.array([turn.x, turn.y, turn.z, turn.w])
    if not np.isfinite(position).all() or not np.isfinite(q).all():
        raise ParameterError("pose", [*position.tolist(), *q.tolist()], "finite numbers")
    if not q.any():
        q = np.array([0.0, 0.0, 0.0, 1.0])
    if abs(float(np.linalg.norm(q)) - 1.0) > UNIT:
        raise ParameterError("orientation", q.tolist(), "a unit quaternion [x, y, z, w]")
    return pose_matrix(position, q)


def pose_target(message: Any, frame: str, base: Array) -> PoseTarget:
    """Return a ``geometry_msgs/Pose`` as a goal of a frame; a quaternion of zeros leaves the orientation free.

    Args:
        message: The pose.
        frame: Name of a hand, a link or a held object.
        base: Pose in the world of the frame that the message is in, shape (4, 4) [m].

    Raises:
        ApexError: A number is not finite, or the quaternion has another length than 1.
    """
    turn, pose = message.orientation, pose_fields(base @ pose_of(message))
    if not any((turn.x, turn.y, turn.z, turn.w)):
        del pose["orientation"]
    return validate(PoseTarget, {"frame": frame, **pose}, "pose")


def joint_goal(message: Any, ours: Mapping[str, str]) -> dict[str, float]:
    """Return the positions of a ``sensor_msgs/JointState`` by our names of joints.

    Args:
        message: Joints and their positions.
        ours: Our names by those in ROS.

    Raises:
        ParameterError: A joint is unknown or comes twice, or its position is missing or not finite.
    """
    if not message.name:
        raise ParameterError("goal", "no joints", "names and positions of joints")
    if len(message.name) != len(message.position):
        raise ParameterError("goal", f"{len(message.position)} positions", f"one for each of {len(message.name)} names")
    found = dict[str, float]()
    for name, position in zip(message.name, message.position, strict=True):
        if name not in ours:
            raise ParameterError("goal", name, f"joints of the robot: {', '.join(ours)}")
        if ours[name] in found:
            raise ParameterError("goal", name, "each joint once")
        if not math.isfinite(position):
            raise ParameterError(f"goal: {name}", position, "a finite number")
        found[ours[name]] = float(position)
    return found


def marker_name(marker: Any, head: str) -> str:
    """Return the name of the obstacle of a marker: a head, its namespace and its number."""
    space = re.sub(r"[^A-Za-z0-9_./-]+", "_", marker.ns)
    return "/".join(filter(None, (head, space, str(marker.id))))


def obstacles_of(marker: Any, name: str, base: Array) -> list[Obstacle]:
    """Return the obstacles of a ``visualization_msgs/Marker``: one, or one for each point of a list.

    Args:
        marker: A cube, ball, cylinder or mesh, or a list of cubes or balls.
        name: Name of the obstacle.
        base: Pose in the world of the frame of its header, shape (4, 4) [m].

    Raises:
        ApexError: It is of another kind, or faulty.
    """
    pose, shape = base @ pose_of(marker.pose), _shape(marker, name)
    if marker.type not in (CUBE_LIST, SPHERE_LIST):
        return [_obstacle(name, shape, pose)]
    found = []
    for k, point in enumerate(marker.points):
        at = pose.copy()
        at[:3, 3] += pose[:3, :3] @ (point.x, point.y, point.z)
        found.append(_obstacle(f"{name}/{k}", shape, at))
    return found


def _obstacle(name: str, shape: Mapping[str, Any], pose: Array) -> Obstacle:
    return validate(Obstacle, {"name": name, **shape, **pose_fields(pose)}, "marker")


def _shape(marker: Any, name: str) -> dict[str, Any]:
    """Return the field of an obstacle that has the shape of a marker; a ball or cylinder holds an ellipse."""
    size = marker.scale.x, marker.scale.y, marker.scale.z
    if marker.type in (CUBE, CUBE_LIST):
        return {"box": size}
    if marker.type in (SPHERE, SPHERE_LIST):
        return {"sphere": {"radius": 0.5 * max(size)}}
    if marker.type == CYLINDER:
        return {"cylinder": {"radius": 0.5 * max(size[:2]), "length": size[2]}}
    if marker.type == MESH:
        return {"mesh": {"file": _file(marker.mesh_resource), "scale": size}}
    kind = KINDS.get(marker.type, f"type {marker.type}")
    raise ParameterError(f"marker {name}", kind, "a cube, ball, cylinder or mesh, or a list of them")


def _file(resource: str) -> str:
    """Return the path of a mesh that a marker names by a URL of this machine.

    Raises:
        ParameterError: It is none.
    """
    url = urlparse(resource)
    if url.scheme not in ("file", "") or url.netloc:
        raise ParameterError("mesh_resource", resource, "the URL of a file, file:///FOLDER/NAME.stl")
    return unquote(url.path)


def cloud_points(cloud: Any) -> Array:
    """Return the points of a ``sensor_msgs/PointCloud2`` in its frame, shape (N, 3) [m]; without those not finite.

    Raises:
        ParameterError: It has no coordinates x, y and z as floats, or fewer bytes than it says.
    """
    fields = {field.name: field for field in cloud.fields}
    order = ">" if cloud.is_bigendian else "<"
    formats = []
    for name in "xyz":
        if name not in fields or fields[name].datatype not in FLOATS:
            raise ParameterError("cloud", ", ".join(fields) or "no fields", "fields x, y and z of 32 or 64 bits")
        formats.append(order + FLOATS[fields[name].datatype])
    offsets = [fields[name].offset for name in "xyz"]
    ends = [offset + np.dtype(one).itemsize for offset, one in zip(offsets, formats, strict=True)]
    if max(ends) > cloud.point_step or cloud.row_step < cloud.width * cloud.point_step:
        raise ParameterError("cloud", f"steps {cloud.point_step} and {cloud.row_step}", "steps that hold its points")
    if len(cloud.data) < cloud.height * cloud.row_step:
        raise ParameterError("cloud", f"{len(cloud.data)} bytes", f"{cloud.height * cloud.row_step}")
    kind = np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": cloud.point_step})
    if not cloud.height * cloud.width:
        return np.zeros((0, 3))
    data = np.frombuffer(cloud.data, np.uint8, cloud.height * cloud.row_step).reshape(cloud.height, cloud.row_step)
    rows = np.ascontiguousarray(data[:, : cloud.width * cloud.point_step]).view(kind).ravel()
    found: Array = np.stack([rows[name].astype(float) for name in "xyz"], axis=1)
    return found[np.isfinite(found).all(axis=1)]


def thinned(points: Array, cell: float) -> Array:
    """Return the centers of the cells of a grid that hold a point, shape (n, 3) [m].

    Args:
        points: Shape (N, 3) [m].
        cell: Edge of a cell [m].
    """
    cells = np.floor(points / cell).astype(np.int64)
    cells = cells[np.lexsort(cells.T)]  # unlike np.unique of rows, it lets other threads run
    first = np.ones(len(cells), bool)
    first[1:] = (np.diff(cells, axis=0) != 0).any(axis=1)
    return np.asarray((cells[first] + 0.5) * cell, float)


def moved(points: Array, pose: Array) -> Array:
    """Return points of a frame in the world, shape (N, 3) [m]."""
    return points @ pose[:3, :3].T + pose[:3, 3]


class Drawing:
    """Markers for RViz, which replace those that were drawn before."""

    def __init__(self, ros: Any, frame: str, stamp: Any) -> None:
        """Draw in a frame at a time."""
        self._ros, self._frame, self._stamp = ros, frame, stamp
        self.message = ros.MarkerArray()
        self._add("", 0, (0.0, 0.0, 0.0, 0.0)).action = DELETE_ALL

    def _add(self, space: str, kind: int, color: Sequence[float]) -> Any:
        marker = self._ros.Marker(ns=space, id=len(self.message.markers), type=kind, action=ADD)
        marker.header.frame_id, marker.header.stamp = self._frame, self._stamp
        r, g, b, a = color
        marker.color = self._ros.ColorRGBA(r=r, g=g, b=b, a=a)
        self.message.markers.append(marker)
        return marker

    def _points(self, points: Array) -> list[Any]:
        return [self._ros.Point(x=x, y=y, z=z) for x, y, z in points.tolist()]

    def add_obstacle(self, space: str, obstacle: Obstacle, color: Sequence[float]) -> None:
        """Draw an obstacle; half-spaces, grids and points of files are left out."""
        pose = obstacle.pose
        for kind, size, offset in _parts(obstacle):
            marker = self._add(space, kind, color)
            at = pose[:3, 3] + pose[:3, :3] @ offset
            _set(marker.pose.position, "xyz", at.tolist())
            _set(marker.pose.orientation, "xyzw", obstacle.orientation)
            _set(marker.scale, "xyz", size)
        if obstacle.mesh is not None:
            marker = self._add(space, MESH, color)
            marker.mesh_resource = Path(obstacle.mesh.file).as_uri()
            _set(marker.pose.position, "xyz", obstacle.position)
            _set(marker.pose.orientation, "xyzw", obstacle.orientation)
            _set(marker.scale, "xyz", obstacle.mesh.scale)

    def add_balls(self, space: str, points: Array, size: float, color: Sequence[float]) -> None:
        """Draw balls of a diameter around points, shape (N, 3) [m], of which ``MOST_POINTS`` at most."""
        marker = self._add(space, SPHERE_LIST, color)
        _set(marker.scale, "xyz", (size, size, size))
        marker.points = self._points(points[:: len(points) // MOST_POINTS + 1])

    def add_line(self, space: str, points: Array, width: float, color: Sequence[float]) -> None:
        """Draw a line through points, shape (N, 3) [m]."""
        marker = self._add(space, LINE_STRIP, color)
        marker.scale.x = width
        marker.points = self._points(points)


def _set(message: Any, names: str, values: Iterable[float]) -> None:
    for name, value in zip(names, values, strict=True):
        setattr(message, name, float(value))


def _parts(obstacle: Obstacle) -> Iterator[tuple[int, tuple[float, float, float], Array]]:
    """Yield the markers of a shape: type, size, and place in the obstacle's frame [m]."""
    center = np.zeros(3)
    if obstacle.box is not None:
        yield CUBE, obstacle.box, center
    if obstacle.sphere is not None:
        yield SPHERE, (2 * obstacle.sphere.radius,) * 3, center
    bar = obstacle.cylinder or obstacle.capsule
    if bar is not None:
        yield CYLINDER, (2 * bar.radius, 2 * bar.radius, bar.length), center
    if obstacle.capsule is not None:
        for end in (-0.5, 0.5):
            yield SPHERE, (2 * obstacle.capsule.radius,) * 3, np.array([0.0, 0.0, end * obstacle.capsule.length])
