"""Reading of MoveIt's messages as plain data: parts of a form, and what they mean to a robot.

Each method raises an error that names the file, the part and its value where that has another form.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from apex_ompl.errors import FileFormatError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.robot.config import resolve
from apex_ompl.scene.bodies import pose_matrix
from apex_ompl.types import Array
from apex_ompl.util.schema import StrictModel, validate
from apex_ompl.util.validation import is_integer, is_number

PRIMITIVES = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone"}
ADD, REMOVE = 0, 1  # operations of moveit_msgs/CollisionObject
OPERATIONS = {"add": ADD, "remove": REMOVE}
WORLD_FRAMES = ("", "world", "map")
TURN = 3.14  # tolerance of an angle from which turns about an axis are free [rad]
RecordT = TypeVar("RecordT", bound=StrictModel)


@dataclass
class MessageReader:
    """Reads parts of the messages in a file; all methods raise a FileFormatError where a part has another form."""

    file: Path

    def fail(self, where: str, value: object, expected: str) -> FileFormatError:
        """Return the error of a value in the file."""
        return FileFormatError(str(self.file), where, value, expected)

    def section(self, data: Mapping[str, Any], key: str, where: str = "") -> Mapping[str, Any]:
        """Return a mapping inside a message, empty where it is not given."""
        found = data.get(key)
        if found is not None and not isinstance(found, Mapping):
            raise self.fail(inside(where, key), found, "expected a mapping of keys to values")
        return found or {}

    def entries(self, data: Mapping[str, Any], key: str, where: str = "") -> list[Any]:
        """Return a list inside a message, empty where it is not given."""
        found = data.get(key)
        if found is not None and not isinstance(found, list):
            raise self.fail(inside(where, key), found, "expected a list")
        return found or []

    def messages(self, data: Mapping[str, Any], key: str, where: str = "") -> list[Mapping[str, Any]]:
        """Return a list of messages inside a message, empty where it is not given."""
        found = self.entries(data, key, where)
        for k, item in enumerate(found):
            if not isinstance(item, Mapping):
                raise self.fail(f"{inside(where, key)}.{k}", item, "expected a mapping of keys to values")
        return found

    def number(self, value: Any, where: str) -> float:
        """Return a finite number."""
        if not is_number(value) or not np.isfinite(value):
            raise self.fail(where, value, "expected a finite number")
        return float(value)

    def flag(self, value: Any, where: str) -> bool:
        """Return a truth value, which a text such as ``"false"`` is not."""
        if not isinstance(value, bool):
            raise self.fail(where, value, "expected true or false")
        return value

    def numbers(self, data: Any, keys: str, default: Sequence[float], where: str) -> Array:
        """Return an array of finite numbers, given as a list or by their keys.

        Args:
            data: The message.
            keys: Their keys, one letter each.
            default: Values of those that are not given.
            where: Place of the message in the file.

        Raises:
            FileFormatError: It holds something else.
        """
        if data is None:
            return np.array(default)
        values = [data.get(k, d) for k, d in zip(keys, default, strict=True)] if isinstance(data, Mapping) else data
        numbers = isinstance(values, list) and len(values) == len(keys) and all(map(is_number, values))
        if not numbers or not np.isfinite(values).all():
            raise self.fail(where, data, f"expected {len(keys)} finite numbers")
        return np.array(values, float)


def inside(where: str, key: str) -> str:
    """Return the dotted path of a key inside a part of a file."""
    return f"{where}.{key}" if where else key


@dataclass
class RobotMessageReader(MessageReader):
    """Reads messages about a robot.

    Attributes:
        robot: The robot.
        joint_map: Joint in the messages -> planned joint of the robot.
        frame_map: Frame in the messages -> ``world`` or a link of the robot.
        notes: What was left out without effect.
    """

    robot: Robot
    joint_map: Mapping[str, str]
    frame_map: Mapping[str, str]
    notes: list[str] = field(default_factory=list)

    def joint(self, name: str, where: str) -> str | None:
        """Return the name of a planned joint of this robot, or None if the robot does not plan the joint."""
        mapped = self.joint_map.get(name, name)
        if mapped in self.robot.joint_names:
            return mapped
        if name in self.joint_map:
            raise UnknownNameError(f"joint in the map of {name!r}", mapped, self.robot.joint_names)
        note = f"{where}: joint {name!r} is not planned by {self.robot.name}"
        if note not in self.notes:
            self.notes.append(note)
        return None

    def frame(self, name: str, start: Array, where: str) -> Array:
        """Return the pose of a frame in the world at the start state, shape (4, 4)."""
        name = self.frame_map.get(name, name).lstrip("/")
        if name in WORLD_FRAMES:
            return np.eye(4)
        if name in self.robot.link_names:
            return self.robot.link_pose(start, name)
        expected = f"expected the frame world or a link of {self.robot.name}; map it with --frame {name}=LINK"
        raise self.fail(f"{where}.header.frame_id", name, expected)

    def pose(self, data: Any, where: str) -> Array:
        """Return a pose message as a matrix, shape (4, 4) [m]; the identity when the message is empty."""
        if not data:
            return np.eye(4)
        if not isinstance(data, Mapping):
            raise self.fail(where, data, "expected a mapping of keys to values")
        position = self.numbers(data.get("position"), "xyz", (0.0, 0.0, 0.0), f"{where}.position")
        turn = self.numbers(data.get("orientation"), "xyzw", (0.0, 0.0, 0.0, 1.0), f"{where}.orientation")
        if not float(np.linalg.norm(turn)) > 1e-6:
            turn = np.array([0.0, 0.0, 0.0, 1.0])  # an empty message means no rotation
        return pose_matrix(position, turn)

    def state(self, data: Mapping[str, Any], where: str) -> dict[str, float]:
        """Return the planned joints of a robot state message."""
        joints, at = self.section(data, "joint_state", where), f"{where}.joint_state"
        names, positions = self.entries(joints, "name", at), self.entries(joints, "position", at)
        if len(names) != len(positions):
            raise self.fail(at, len(positions), f"expected {len(names)} positions")
        if self.section(data, "multi_dof_joint_state", where).get("joint_names"):
            self.notes.append(f"{where}.multi_dof_joint_state: the robot's base does not move")
        found = {}
        for k, (name, position) in enumerate(zip(names, positions, strict=True)):
            ours = self.joint(str(name), at)
            if ours is not None:
                found[ours] = self.number(position, f"{at}.position.{k}")
        return found

    def shapes(self, item: Mapping[str, Any], where: str) -> Iterator[tuple[dict[str, Any], Array]]:
        """Yield (shape fields, pose in the object's frame) of an object message."""
        for k, (primitive, pose) in enumerate(self.paired(item, "primitives", "primitive_poses", where)):
            yield self.primitive(primitive, f"{where}.primitives.{k}"), pose
        for k, (mesh, pose) in enumerate(self.paired(item, "meshes", "mesh_poses", where)):
            yield self.mesh(mesh, f"{where}.meshes.{k}"), pose
        for k, (plane, pose) in enumerate(self.paired(item, "planes", "plane_poses", where)):
            a, b, c, d = self.numbers(plane.get("coef"), "abcd", (0, 0, 1, 0), f"{where}.planes.{k}.coef")
            self.notes.append(f"{where}.planes.{k}: read as the half-space below the plane")
            yield {"half_space": {"normal": (a, b, c), "offset": -d}}, pose

    def paired(self, item: Mapping[str, Any], shapes: str, poses: str, where: str) -> list[tuple[Any, Array]]:
        """Return shapes with their poses, of shape (4, 4)."""
        found, placed = self.messages(item, shapes, where), self.entries(item, poses, where)
        if placed and len(placed) != len(found):
            raise self.fail(f"{where}.{poses}", len(placed), f"expected {len(found)} poses, one per shape")
        placed = placed or [None] * len(found)
        return [(s, self.pose(p, f"{where}.{poses}.{k}")) for k, (s, p) in enumerate(zip(found, placed, strict=True))]

    def primitive(self, data: Mapping[str, Any], where: str) -> dict[str, Any]:
        """Return the fields of a shape_msgs/SolidPrimitive."""
        kind = self.constant(data.get("type"))
        kind = PRIMITIVES.get(kind, kind) if is_integer(kind) else str(kind).strip().lower()
        size = self.entries(data, "dimensions", where)
        counts = {"box": 3, "sphere": 1, "cylinder": 2}
        if kind not in counts:
            raise self.fail(f"{where}.type", data.get("type"), "cannot be read, expected box, sphere or cylinder")
        if len(size) != counts[kind]:
            raise self.fail(f"{where}.dimensions", size, f"expected {counts[kind]} numbers for a {kind}")
        values = [self.number(v, f"{where}.dimensions.{k}") for k, v in enumerate(size)]
        if kind == "box":
            return {"box": tuple(values)}
        if kind == "sphere":
            return {"sphere": {"radius": values[0]}}
        return {"cylinder": {"radius": values[1], "length": values[0]}}

    def constrained_link(self, message: Mapping[str, Any], start: Array, where: str) -> tuple[str, Array]:
        """Return the link of a constraint, and the pose of the frame that it is given in, shape (4, 4)."""
        given = str(message.get("link_name"))
        link = self.frame_map.get(given, given).lstrip("/")
        if link not in self.robot.link_names:
            expected = f"expected a link of {self.robot.name}; map it with --frame {given}=LINK"
            raise self.fail(f"{where}.link_name", given, expected)
        name = str(self.section(message, "header", where).get("frame_id", ""))
        base = self.frame_map.get(name, name).lstrip("/")
        if base in self.robot.link_names:
            model = self.robot.model
            if model.frames[self.robot.link_frame(base)].parentJoint != 0:
                raise self.fail(f"{where}.header.frame_id", name, "cannot be read, expected a frame that does not move")
        return link, self.frame(name, start, where)

    def angles(self, message: Mapping[str, Any], where: str) -> tuple[list[str], float]:
        """Return the axes about which turns are free, none, one or all, and the least tolerance of the others [rad]."""
        keys = [f"absolute_{axis}_axis_tolerance" for axis in "xyz"]
        angles = [self.number(message.get(key, 0.0), f"{where}.{key}") for key in keys]
        if min(angles) <= 0.0:
            raise self.fail(where, angles, "expected three tolerances of angles above 0")
        free = [axis for axis, angle in zip("xyz", angles, strict=True) if angle >= TURN]
        kept = [angle for angle in angles if angle < TURN]
        if len(free) == 2:
            raise self.fail(where, angles, "cannot be read, expected at most one tolerance from pi, or three")
        if len({*kept}) > 1:
            self.notes.append(f"{where}: its tolerances differ, and the smallest holds for all")
        return free, min(kept, default=np.inf)

    def refuse(self, data: Mapping[str, Any], key: str, value: object, expected: str, where: str = "") -> None:
        """Raise a FileFormatError where a part of a message is there and not empty."""
        found = data.get(key)
        if any(found.values()) if isinstance(found, Mapping) else found:
            raise self.fail(inside(where, key), value, expected)

    def record(self, kind: type[RecordT], fields: dict[str, Any], where: str) -> RecordT:
        """Return an obstacle, a held object or a constraint."""
        try:
            return validate(kind, fields, str(self.file))
        except FileFormatError as error:
            raise self.fail(
                inside(where, error.field) if error.field else where, error.value, error.expected
            ) from error

    def operation(self, item: Mapping[str, Any], known: tuple[int, ...], where: str) -> int:
        """Return what is done with an object, out of the known operations."""
        given = item.get("operation", ADD)
        found = self.constant(given)
        found = OPERATIONS.get(found.strip().lower(), found) if isinstance(found, str) else found
        if not is_integer(found) or found not in known:
            also = f", or {REMOVE} or remove to remove it" if REMOVE in known else ""
            raise self.fail(f"{where}.operation", given, f"expected {ADD} or add to add an object{also}")
        return int(found)

    def constant(self, value: Any) -> Any:
        """Return a constant as a number where it is one, or a text of digits, or the byte that tools of ROS print."""
        if isinstance(value, bytes) and len(value) == 1:
            return value[0]
        if isinstance(value, str):
            if value.strip().isdecimal():
                return int(value)
            return ord(value) if len(value) == 1 and not value.isprintable() else value
        return value

    def mesh(self, data: Mapping[str, Any], where: str) -> dict[str, Any]:
        """Return the fields of a mesh that is named by its path."""
        resource = data.get("resource")
        if not resource:
            raise self.fail(where, sorted(data), "cannot be read, expected a mesh by path (resource)")
        scale = self.numbers(data.get("dimensions") or data.get("scale"), "xyz", (1.0, 1.0, 1.0), f"{where}.scale")
        file = resolve(str(resource), self.file.resolve().parent, f"mesh {where}")
        return {"mesh": {"file": str(file), "scale": tuple(scale.tolist())}}
