"""Import of MoveIt and MotionBenchMaker files: a planning scene and a motion plan request, both as YAML.

The messages are ``moveit_msgs/PlanningScene`` (or its ``world`` alone) and ``moveit_msgs/MotionPlanRequest``, in either
of two spellings: poses as lists or as x/y/z(/w) mappings, primitive types by name or by number. The pose of a primitive
is composed with that of its object and of the object's frame; every primitive of an object becomes an obstacle. Allowed
collision matrices (``moveit_msgs/AllowedCollisionMatrix``) become pairs of bodies that may touch, ``path_constraints``
(``moveit_msgs/Constraints``) constraints along the path. Content that would change the problem and is not supported is
an error that names it. Content that is left out without effect is listed in the notes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.robot.moveit_messages import ADD, REMOVE, MessageReader, RobotMessageReader
from apex_ompl.scene.bodies import AttachedObject, Obstacle, pose_fields, pose_matrix
from apex_ompl.scene.constraints import Constraint, FixedOrientation, ToolRegion, Upright
from apex_ompl.scene.grids import OCTOMAP_HEAD
from apex_ompl.scene.problem import Goal, PoseTarget, Problem
from apex_ompl.types import Array
from apex_ompl.util.schema import read_yaml, validate
from apex_ompl.util.validation import is_integer

MATRIX = "allowed_collision_matrix"
SIDES = ("above", "below")  # of a joint's tolerances
EXACT_ANGLE = 0.01  # tolerance up to which an orientation counts as fixed [rad]
ALONG = 1e-3  # largest element of a rotation that counts as 0
SAME_POINT = 1e-4  # largest distance between points that count as the same [m]
HARMLESS = ("workspace_parameters", "planner_id", "num_planning_attempts", "allowed_planning_time", "pipeline_id")


Pair = tuple[str, str]


def allowed_pairs(
    reader: MessageReader, matrix: Mapping[str, Any], robot: Robot, bodies: Sequence[str], names: Mapping[str, str]
) -> tuple[list[Pair], list[str]]:
    """Return the pairs that a matrix lets touch and that are checked here, and names that are no link or object.

    An object of several shapes stands for all of them. A name whose default allows contact may touch every body unless
    an entry forbids it.

    Args:
        reader: Reader of the scene's file.
        matrix: The matrix; may be empty.
        robot: The robot.
        bodies: Names of the obstacles and held objects.
        names: Link in the file -> link of ``robot``.

    Raises:
        FileFormatError: The matrix is not square, or has other faults; a value that is neither true nor false is named
            with its two entries.
    """
    entries = [str(name) for name in reader.entries(matrix, "entry_names", MATRIX)]
    given = reader.entries(matrix, "entry_values", MATRIX)
    if given and all(isinstance(row, list) for row in given):  # as MotionBenchMaker writes them
        rows = given
    else:
        rows = [
            reader.entries(row, "enabled", f"{MATRIX}.entry_values.{k}")
            for k, row in enumerate(reader.messages(matrix, "entry_values", MATRIX))
        ]
    if [len(row) for row in rows] != [len(entries)] * len(entries):
        expected = f"expected {len(entries)} rows of {len(entries)} values, one for each of entry_names"
        raise reader.fail(f"{MATRIX}.entry_values", len(rows), expected)
    flags = [
        [
            reader.flag(value, f"{MATRIX}.entry_values.{k}.{j} ({entries[k]}, {entries[j]})")
            for j, value in enumerate(row)
        ]
        for k, row in enumerate(rows)
    ]
    defaults = [str(name) for name in reader.entries(matrix, "default_entry_names", MATRIX)]
    values = reader.entries(matrix, "default_entry_values", MATRIX)
    if len(values) != len(defaults):
        raise reader.fail(f"{MATRIX}.default_entry_values", len(values), f"expected {len(defaults)} values")
    usual = [
        reader.flag(value, f"{MATRIX}.default_entry_values.{k} ({name})")
        for k, (name, value) in enumerate(zip(defaults, values, strict=True))
    ]
    known = (*dict.fromkeys((*robot.link_names, *bodies)),)
    ours = {name: _bodies_of(names.get(name, name), known) for name in (*entries, *defaults)}
    unknown = sorted(name for name, found in ours.items() if not found)
    allowed, kept_apart = set[Pair](), set[Pair]()
    for i, j in product(range(len(entries)), repeat=2):
        if i != j:
            pairs = set(map(_sorted, product(ours[entries[i]], ours[entries[j]])))
            allowed, kept_apart = (allowed | pairs, kept_apart) if flags[i][j] else (allowed, kept_apart | pairs)
    for name, value in zip(defaults, usual, strict=True):
        if value:
            allowed |= set(map(_sorted, product(ours[name], known))) - kept_apart
    links = set(robot.link_names)
    checked = _pairs_of_links(robot)
    return sorted(p for p in allowed if p[0] != p[1] and (p in checked or not links.issuperset(p))), unknown


def _sorted(pair: Iterable[str]) -> Pair:
    first, second = sorted(pair)
    return first, second


def _bodies_of(name: str, known: Iterable[str]) -> list[str]:
    """Return the bodies that an object or link of a file stands for; several where it has several shapes."""
    label = re.sub(r"[^A-Za-z0-9_.-]+", "_", name.strip()).strip("_.-")
    return [body for body in known if body in (name, label) or re.fullmatch(rf"{re.escape(label)}/\d+", body)]


def _pairs_of_links(robot: Robot) -> set[Pair]:
    """Return the pairs of links that the robot checks against each other."""
    links = [link_of(robot.model, item) for item in robot.geometry.geometryObjects]
    return {_sorted((links[p.first], links[p.second])) for p in robot.geometry.collisionPairs}


@dataclass
class Conversion:
    """A converted problem, with notes on the content of the files that was left out."""

    problem: Problem
    notes: list[str] = field(default_factory=list)


def convert(
    scene: Path,
    request: Path,
    robot: Robot,
    joint_map: Mapping[str, str] | None = None,
    frame_map: Mapping[str, str] | None = None,
) -> Conversion:
    """Return the problem of a planning scene and a motion plan request.

    Args:
        scene: YAML of a ``moveit_msgs/PlanningScene`` or its world.
        request: YAML of a ``moveit_msgs/MotionPlanRequest``.
        robot: The robot.
        joint_map: Joint name in the files -> planned joint of ``robot``.
        frame_map: Frame in the files -> ``world`` or a link of ``robot``.

    Raises:
        MissingFileError: A file or a mesh cannot be read.
        FileFormatError: Content is faulty or not supported; the message names it.
        UnknownNameError: The joint map names an unknown joint.
    """
    messages = read_yaml(scene, "scene file"), read_yaml(request, "request file")
    return converted(*messages, robot, joint_map, frame_map, scene=scene, request=request)


def converted(
    scene_data: Mapping[str, Any],
    request_data: Mapping[str, Any],
    robot: Robot,
    joint_map: Mapping[str, str] | None = None,
    frame_map: Mapping[str, str] | None = None,
    *,
    scene: Path = Path("scene"),
    request: Path = Path("request"),
) -> Conversion:
    """Return the problem of messages as plain data (:func:`convert`).

    Args:
        scene_data: A ``moveit_msgs/PlanningScene`` or its world.
        request_data: A ``moveit_msgs/MotionPlanRequest``.
        robot: The robot.
        joint_map: Joint name in the messages -> planned joint of ``robot``.
        frame_map: Frame in the messages -> ``world`` or a link of ``robot``.
        scene: What the scene is called in errors, and where meshes are looked for.
        request: What the request is called in errors.

    Raises:
        MissingFileError: A mesh cannot be read.
        FileFormatError: Content is faulty or not supported; the message names it.
        UnknownNameError: The joint map names an unknown joint.
    """
    notes: list[str] = []
    at_scene = RobotMessageReader(scene, robot, joint_map or {}, frame_map or {}, notes)
    at_request = RobotMessageReader(request, robot, joint_map or {}, frame_map or {}, notes)
    scene_state = at_scene.section(scene_data, "robot_state")
    start_state = at_request.section(request_data, "start_state")
    start = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    given = at_scene.state(scene_state, "robot_state") | at_request.state(start_state, "start_state")
    if not given:
        raise at_request.fail("start_state.joint_state", None, "expected joints of the robot; is a joint map missing?")
    missing = [name for name in robot.joint_names if name not in given]
    if missing:
        notes.append(f"start: {', '.join(missing)} not given, taken at home")
    start |= given
    q = np.array([start[name] for name in robot.joint_names])
    obstacles = _obstacles(at_scene, scene_data, q)
    attached = list(_attached(at_scene, scene_state, "robot_state", q))
    attached += list(_attached(at_request, start_state, "start_state", q))
    bodies = [body.name for body in (*obstacles, *attached)]
    allowed, unknown = allowed_pairs(at_scene, at_scene.section(scene_data, MATRIX), robot, bodies, frame_map or {})
    if unknown:
        notes.append(f"{MATRIX}: neither links nor objects here, so left out: {', '.join(unknown)}")
    for key, usual in (("link_padding", 0.0), ("link_scale", 1.0)):
        if any(item.get(key.removeprefix("link_"), usual) != usual for item in at_scene.messages(scene_data, key)):
            notes.append(f"{key}: not used, the robot has its own size")
    constraints = tuple(_path_constraints(at_request, request_data, q))
    goal = _goal(at_request, request_data, start)
    for key in HARMLESS:
        if request_data.get(key):
            notes.append(f"{key}: not used")
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", scene.stem).strip("_.-") or "converted"
    fields = {
        "name": name, "robot": robot.name, "scene": tuple(obstacles), "attached": tuple(attached),
        "allowed": tuple(allowed), "start": start,
        "goal": goal, "constraints": constraints,
    }  # fmt: skip
    problem = validate(Problem, fields, str(scene))
    return Conversion(problem, notes)


def _obstacles(reader: RobotMessageReader, data: Mapping[str, Any], start: Array) -> list[Obstacle]:
    world = reader.section(data, "world") if "world" in data else data
    octree = _octree(reader, reader.section(world, "octomap", "world"), start)
    found: dict[str, list[Obstacle]] = {}  # by the object's name; operations are carried out one after the other
    for k, item in enumerate(reader.messages(world, "collision_objects")):
        where = f"collision_objects.{k}"
        label = str(item.get("id", "")).strip()
        if reader.operation(item, (ADD, REMOVE), where) == REMOVE:
            gone = list(found) if not label else [label] if label in found else []  # without a name: all
            reader.notes.append(f"{where}: removes {', '.join(map(repr, gone)) or repr(label)}")
            found = {name: bodies for name, bodies in found.items() if name not in gone}
            continue
        base = reader.frame(str(reader.section(item, "header", where).get("frame_id", "")), start, where)
        found[label or where] = [  # in place of what was added by that name before
            reader.record(Obstacle, {"name": name, **shape, **pose_fields(base @ pose)}, where)
            for name, shape, pose in _bodies(reader, item, where)
        ]
    return [body for bodies in found.values() for body in bodies] + octree


def _octree(reader: RobotMessageReader, message: Mapping[str, Any], start: Array) -> list[Obstacle]:
    """Return the obstacle of an ``octomap_msgs/OctomapWithPose``, or none where it is empty."""
    where = "world.octomap.octomap"
    octomap = reader.section(message, "octomap", "world.octomap")
    given = octomap.get("data")
    if not given:
        return []
    if not reader.flag(octomap.get("binary", False), f"{where}.binary") or octomap.get("id") != "OcTree":
        raise reader.fail(where, octomap.get("id"), "cannot be read, expected a binary map of the kind OcTree")
    if not isinstance(given, bytes):
        values = reader.entries(octomap, "data", where)
        if not all(is_integer(value) and -128 <= value < 256 for value in values):
            raise reader.fail(f"{where}.data", "a list", "expected bytes, as whole numbers")
        given = bytes(value % 256 for value in values)
    side = reader.number(octomap.get("resolution"), f"{where}.resolution")
    head = f"{OCTOMAP_HEAD.decode()}\nid OcTree\nsize 0\nres {side!r}\ndata\n"
    base = reader.frame(str(reader.section(message, "header", "world.octomap").get("frame_id", "")), start, where)
    pose = base @ reader.pose(message.get("origin"), "world.octomap.origin")
    voxels = {"file": "octomap.bt", "content": head.encode() + given}
    return [reader.record(Obstacle, {"name": "octomap", "voxels": voxels, **pose_fields(pose)}, where)]


def _attached(
    reader: RobotMessageReader, state: Mapping[str, Any], where: str, start: Array
) -> Iterator[AttachedObject]:
    for k, entry in enumerate(reader.messages(state, "attached_collision_objects", where)):
        here = f"{where}.attached_collision_objects.{k}"
        link = reader.frame_map.get(str(entry.get("link_name")), str(entry.get("link_name")))
        item = reader.section(entry, "object", here)
        reader.operation(item, (ADD,), f"{here}.object")
        frame = str(reader.section(item, "header", f"{here}.object").get("frame_id", ""))
        inside = np.linalg.inv(reader.robot.link_pose(start, link))
        # MoveIt gives an attached object in the frame of its link unless the header says otherwise.
        base = np.eye(4) if frame in ("", str(entry.get("link_name"))) else inside @ reader.frame(frame, start, here)
        touch = [reader.frame_map.get(str(t), str(t)) for t in reader.entries(entry, "touch_links", here)]
        unknown = [t for t in touch if t not in reader.robot.link_names]
        if unknown:
            reader.notes.append(f"{here}.touch_links: {', '.join(unknown)} are no links of {reader.robot.name}")
        known = tuple(t for t in touch if t in reader.robot.link_names)
        for label, shape, pose in _bodies(reader, item, here):
            fields = {"name": label, "link": link, **shape, **pose_fields(base @ pose)}
            if known:
                fields["touch_links"] = tuple({*known, *reader.robot.hand_of(link)})
            yield reader.record(AttachedObject, fields, here)


def _bodies(reader: RobotMessageReader, item: Mapping[str, Any], where: str) -> list[tuple[str, dict[str, Any], Array]]:
    """Return (name, shape fields, pose in the object's header frame) of every shape of an object."""
    label = re.sub(r"[^A-Za-z0-9_.-]+", "_", str(item.get("id", "")).strip()).strip("_.-")
    label = label or where.replace(".", "_")
    own = reader.pose(item.get("pose"), f"{where}.pose")
    shapes = list(reader.shapes(item, where))
    if not shapes:
        raise reader.fail(where, sorted(item), "expected primitives, meshes or planes")
    names = [label] if len(shapes) == 1 else [f"{label}/{k}" for k in range(len(shapes))]
    return [(name, shape, own @ pose) for name, (shape, pose) in zip(names, shapes, strict=True)]


def _path_constraints(reader: RobotMessageReader, data: Mapping[str, Any], start: Array) -> Iterator[Constraint]:
    """Yield the constraints of ``path_constraints``, which imply those of the message."""
    reader.refuse(data, "trajectory_constraints", "constraints of a trajectory", "cannot be read, expected none")
    where = "path_constraints"
    message = reader.section(data, where)
    reader.refuse(message, "visibility_constraints", "a list", "cannot be read, expected none", where)
    for k, joint in enumerate(reader.messages(message, "joint_constraints", where)):
        _check_joint_constraint(reader, joint, f"{where}.joint_constraints.{k}")
    for k, orientation in enumerate(reader.messages(message, "orientation_constraints", where)):
        yield from _orientation_constraint(reader, orientation, start, f"{where}.orientation_constraints.{k}")
    for k, position in enumerate(reader.messages(message, "position_constraints", where)):
        yield _position_constraint(reader, position, start, f"{where}.position_constraints.{k}")


def _check_joint_constraint(reader: RobotMessageReader, message: Mapping[str, Any], where: str) -> None:
    """Raise a FileFormatError unless a joint's limits imply its constraint."""
    joint = reader.joint(str(message.get("joint_name")), where)
    if joint is None:
        return
    position = reader.number(message.get("position"), f"{where}.position")
    above, below = (reader.number(message.get(f"tolerance_{side}", 0.0), f"{where}.tolerance_{side}") for side in SIDES)
    k = reader.robot.joint_names.index(joint)
    lower, upper = float(reader.robot.limits.lower[k]), float(reader.robot.limits.upper[k])
    if position - below > lower or position + above < upper:
        found = [position - below, position + above]
        raise reader.fail(
            where, found, f"cannot be read, expected a range that holds the limits [{lower:g}, {upper:g}]"
        )
    reader.notes.append(f"{where}: not used, the limits of {joint} are inside")


def _orientation_constraint(
    reader: RobotMessageReader, message: Mapping[str, Any], start: Array, where: str
) -> Iterator[Constraint]:
    """Yield a constraint of the orientation, or of one axis where turns about it are free.

    MoveIt bounds the angles about x, y and z of the rotation from the wanted orientation, as Euler angles or as parts
    of the rotation vector. Up to a right angle none of them is larger than the angle of the rotation, which is bounded
    here.
    """
    link, base = reader.constrained_link(message, start, where)
    base = base @ reader.pose({"orientation": message.get("orientation")}, where)
    free, angle = reader.angles(message, where)
    if len(free) == 3:
        reader.notes.append(f"{where}: not used, any orientation is within its tolerances")
        return
    angle, orientation = min(angle, np.pi / 2), {"orientation": pose_fields(base)["orientation"]}
    if free:
        k = "xyz".index(free[0])
        axis, up = np.eye(3)[k], base[:3, k]
        fields = {"frame": link, "axis": tuple(axis.tolist()), "up": tuple(up.tolist()), "angle": angle}
        yield reader.record(Upright, fields, where)
    elif angle <= EXACT_ANGLE:
        yield reader.record(FixedOrientation, {"frame": link, "angle": angle, **orientation}, where)
    else:
        yield reader.record(ToolRegion, {"frame": link, "angle": angle, **orientation}, where)


def _position_constraint(
    reader: RobotMessageReader, message: Mapping[str, Any], start: Array, where: str
) -> ToolRegion:
    """Return the box that a link's origin, or the grasp point of a hand, stays in."""
    frame, shape, pose = _region(reader, message, start, where, ("box",))
    half = np.array(shape["box"]) / 2.0
    fields = {"lower": tuple((-half).tolist()), "upper": tuple(half.tolist()), **pose_fields(pose)}
    return reader.record(ToolRegion, {"frame": frame, **fields}, f"{where}.constraint_region")


def _region(
    reader: RobotMessageReader, message: Mapping[str, Any], start: Array, where: str, kinds: Sequence[str]
) -> tuple[str, dict[str, Any], Array]:
    """Return the frame of a position constraint, a link or a hand, the one shape that it is in, and that one's pose."""
    link, base = reader.constrained_link(message, start, where)
    offset = reader.numbers(message.get("target_point_offset"), "xyz", (0.0, 0.0, 0.0), f"{where}.target_point_offset")
    if float(np.linalg.norm(offset)) > SAME_POINT:
        hands = {name: hand.point for name, hand in reader.robot.hands.items() if hand.palm == link}
        near = [name for name, point in hands.items() if float(np.linalg.norm(offset - point)) <= SAME_POINT]
        if not near:
            expected = "cannot be read, expected 0, or the grasp point of a hand"
            raise reader.fail(f"{where}.target_point_offset", offset.tolist(), expected)
        link = near[0]
    inside_of, expected = f"{where}.constraint_region", f"cannot be read, expected one {' or '.join(kinds)}"
    region = reader.section(message, "constraint_region", where)
    reader.refuse(region, "meshes", "a list", expected, inside_of)
    shapes = reader.paired(region, "primitives", "primitive_poses", inside_of)
    if len(shapes) != 1:
        raise reader.fail(f"{inside_of}.primitives", len(shapes), expected)
    shape = reader.primitive(shapes[0][0], f"{inside_of}.primitives.0")
    if not shape.keys() & set(kinds):
        raise reader.fail(f"{inside_of}.primitives.0", next(iter(shape)), expected)
    return link, shape, base @ shapes[0][1]


def _goal(reader: RobotMessageReader, data: Mapping[str, Any], start: Mapping[str, float]) -> Goal:
    """Return the goal: poses of one or more links, joints, or several of both of which any will do."""
    goals = reader.messages(data, "goal_constraints")
    posed = [bool(goal.get("position_constraints")) and not goal.get("joint_constraints") for goal in goals]
    if not any(posed):
        return Goal(joints=tuple(_joint_goals(reader, dict(enumerate(goals)), start)))
    found = list[Goal]()
    for k, (goal, of_poses) in enumerate(zip(goals, posed, strict=True)):
        if of_poses:
            found.append(Goal(poses=tuple(_pose_targets(reader, goal, start, f"goal_constraints.{k}"))))
        else:
            found.append(Goal(joints=tuple(_joint_goals(reader, {k: goal}, start))))
    return found[0] if len(found) == 1 else Goal(any_of=tuple(found))


def _pose_targets(
    reader: RobotMessageReader, goal: Mapping[str, Any], start: Mapping[str, float], where: str
) -> Iterator[PoseTarget]:
    """Yield a pose for each position constraint: a ball, whose radius is the tolerance, or a box along the axes.

    An orientation constraint of the same link gives the orientation: with the smallest of its tolerances, free about an
    axis whose tolerance is pi, and any where all three are.
    """
    reader.refuse(goal, "visibility_constraints", "a list", "cannot be read, expected none", where)
    q = np.array([start[name] for name in reader.robot.joint_names])
    turns = {str(one.get("link_name")): one for one in reader.messages(goal, "orientation_constraints", where)}
    for k, message in enumerate(reader.messages(goal, "position_constraints", where)):
        at, link = f"{where}.position_constraints.{k}", str(message.get("link_name"))
        frame, shape, pose = _region(reader, message, q, at, ("sphere", "box"))
        turn, tolerance = turns.pop(link, None), dict[str, float]()
        fields: dict[str, Any] = {"frame": frame, "position": pose_fields(pose)["position"], "tolerance": tolerance}
        if turn is not None:
            fields |= _wanted_orientation(reader, turn, q, f"{where}.orientation_constraints of {link}", tolerance)
        if "sphere" in shape:
            tolerance["position"] = shape["sphere"]["radius"]
        else:
            fields |= _box_of_positions(reader, shape["box"], pose, fields.get("orientation"), at)
        yield reader.record(PoseTarget, fields, at)
    if turns:
        raise reader.fail(where, next(iter(turns)), "expected a position for each link with an orientation")


def _wanted_orientation(
    reader: RobotMessageReader, message: Mapping[str, Any], start: Array, where: str, tolerance: dict[str, float]
) -> dict[str, Any]:
    """Return the orientation of a pose and its free turn, where there are any, and add the tolerance of its angle."""
    _, base = reader.constrained_link(message, start, where)
    base = base @ reader.pose({"orientation": message.get("orientation")}, where)
    free, angle = reader.angles(message, where)
    if len(free) == 3:
        return {}
    tolerance["angle"] = angle
    turned = {"free_turn": free[0]} if free else {}
    return {"orientation": pose_fields(base)["orientation"], **turned}


def _box_of_positions(
    reader: RobotMessageReader, size: Sequence[float], pose: Array, orientation: Sequence[float] | None, where: str
) -> dict[str, Any]:
    """Return the least and largest positions in a box, along the axes of the wanted orientation, or of the world."""
    wanted = pose_matrix((0.0, 0.0, 0.0), orientation or (0.0, 0.0, 0.0, 1.0))[:3, :3]
    turn = np.abs(wanted.T @ pose[:3, :3])
    if np.abs(turn - turn.round()).max() > ALONG:
        expected = (
            "cannot be read, expected a box along the axes of the wanted orientation, or of the world without one"
        )
        raise reader.fail(f"{where}.constraint_region.primitive_poses.0", pose[:3, :3].round(4).tolist(), expected)
    half = turn.round() @ np.array(size) / 2.0
    return {"lower": tuple((-half).tolist()), "upper": tuple(half.tolist())}


def _joint_goals(
    reader: RobotMessageReader, found: Mapping[int, Mapping[str, Any]], start: Mapping[str, float]
) -> list[dict[str, float]]:
    goals = []
    for k, goal in found.items():
        where = f"goal_constraints.{k}"
        for other in ("position_constraints", "orientation_constraints", "visibility_constraints"):
            if goal.get(other):
                expected = "cannot be read, expected joint_constraints only, or position_constraints without these"
                raise reader.fail(f"{where}.{other}", "a list", expected)
        values, given, reached = dict(start), reader.messages(goal, "joint_constraints", where), False
        for j, constraint in enumerate(given):
            at = f"{where}.joint_constraints.{j}"
            ours = reader.joint(str(constraint.get("joint_name")), at)
            if ours is not None:
                values[ours], reached = reader.number(constraint.get("position"), f"{at}.position"), True
        if not reached:
            names = ", ".join(str(one.get("joint_name")) for one in given) or None
            expected = f"expected joints of {reader.robot.name}; is a joint map missing?"
            raise reader.fail(f"{where}.joint_constraints", names, expected)
        goals.append(values)
    if not goals:
        raise reader.fail("goal_constraints", None, "expected at least one goal")
    return goals
