"""Input of plans along straight lines: poses of frames, the tools that they are about, and options."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.constraints.frames import Frame, frame_of
from apex_ompl.constraints.links import Links
from apex_ompl.constraints.tools import Tool, Tools
from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_fields, pose_matrix
from apex_ompl.scene.problem import PoseTarget, Problem
from apex_ompl.timing import Timing
from apex_ompl.types import Array
from apex_ompl.util.validation import check_number, check_positive, finite_array, rigid_pose

LEAST_JOINTS = 6  # that move a tool

Pose = PoseTarget | ArrayLike
"""A pose: a :class:`PoseTarget`; a rigid transform, shape (4, 4); or a position, shape (3,), with the orientation that
the frame had before [m]."""
Waypoint = Pose | Mapping[str, Pose]
"""A pose, or poses by the names of frames."""


class LineQuery(NamedTuple):
    """What a plan along a line is about.

    Attributes:
        problem: The problem, whose goal are the last poses.
        start: The start, inside the limits, shape (dof,).
        tools: The frames, and those of second hands that hold an object with them.
        names: Names of the frames that were given.
        poses: Their poses, that at the start first, shape (K, F, 4, 4).
        blend: Radius of blends [m].
        speed: Largest speed of each frame, or None [m/s].
        timing: How the path is timed, or None.
    """

    problem: Problem
    start: Array
    tools: tuple[Tool, ...]
    names: tuple[str, ...]
    poses: Array
    blend: float
    speed: float | None
    timing: Timing | None


def line_query(
    checker: CollisionChecker, start: Array, pose: Waypoint | Sequence[Waypoint], *, frame: str | None, blend: float,
    speed: float | None, timing: bool | Timing, problem: Callable[[Sequence[PoseTarget]], Problem],
) -> LineQuery:  # fmt: skip
    """Return what a plan along a line is about.

    Args:
        checker: Collision checker.
        start: The start, shape (dof,).
        pose: A pose or several.
        frame: Frame of poses that name none.
        blend: Radius of blends [m].
        speed: Largest speed [m/s].
        timing: How the path is timed, or whether.
        problem: Makes the problem of a goal.

    Raises:
        ApexError: One of them is faulty.
    """
    robot = checker.robot
    check_number(blend, "blend", 0.0)
    if speed is not None:
        check_positive(speed, "speed", "a positive number of m/s")
    if not isinstance(timing, (bool, Timing)):
        raise ParameterError("timing", timing, "True, False or a Timing")
    how = Timing() if timing is True else timing or None
    if how is not None and how.start(how.limits(robot.limits, robot.joint_names)) is not None:
        raise ParameterError("timing", "a moving start", "a start at rest")
    waypoints = [_by_frame(one, frame) for one in _several(pose)]
    names = tuple(waypoints[0])
    for k, waypoint in enumerate(waypoints[1:], 1):
        if set(waypoint) != set(names):
            raise ParameterError(f"pose[{k}]", ", ".join(waypoint), f"poses of {', '.join(names)}")
    frames = [frame_of(robot, name, checker.held, "frame of a line") for name in names]
    q = robot.within_limits(start)
    tools, held_by = _in_both_hands(checker, tools_of(robot, names, frames), q)
    rotation, point = Tools(checker.kernel, tools).poses(q[None])
    poses = np.tile(np.eye(4), (1 + len(waypoints), len(tools), 1, 1))
    poses[0, :, :3, :3], poses[0, :, :3, 3] = rotation[0], point[0]
    for k, waypoint in enumerate(waypoints, 1):
        for f, name in enumerate(names):
            poses[k, f] = _matrix(waypoint[name], poses[k - 1, f], frames[f].axial, f"pose of {name}")
        poses[k, len(names) :] = poses[k, held_by]
    goals = [PoseTarget.model_validate({"frame": n, **pose_fields(poses[-1, f])}) for f, n in enumerate(names)]
    if how is not None:
        how.motion_limits(robot, tuple(checker.held.values()))  # checked before planning
    return LineQuery(problem(goals), q, tools, names, poses, float(blend), speed, how)


def tools_of(robot: Robot, names: Sequence[str], frames: Sequence[Frame]) -> tuple[Tool, ...]:
    """Return the tools of frames by name, each moved by joints of its own.

    Raises:
        ParameterError: A frame is moved by fewer than six joints, or two share a joint.
    """
    taken, tools = dict[int, str](), list[Tool]()
    for name, frame in zip(names, frames, strict=True):
        tool = _tool(robot, name, frame.link, frame.pose)
        if len(tool.columns) < LEAST_JOINTS:
            raise ParameterError("frame", name, f"one that {LEAST_JOINTS} joints or more move, not {len(tool.columns)}")
        for column in tool.columns.tolist():
            if column in taken:
                shared = f"{robot.joint_names[column]} moves {taken[column]} too"
                raise ParameterError("frame", name, f"frames of arms that share no joint ({shared})")
            taken[column] = name
        tools.append(tool)
    return tuple(tools)


def _several(pose: Waypoint | Sequence[Waypoint]) -> list[Any]:
    """Return poses as a list of waypoints.

    Raises:
        ParameterError: There is none, or an array has another shape.
    """
    if isinstance(pose, (PoseTarget, Mapping)):
        return [pose]
    if isinstance(pose, Sequence) and any(isinstance(one, (PoseTarget, Mapping)) for one in pose):
        return list(pose)
    values = finite_array(pose, "pose")  # type: ignore[arg-type]
    if values.shape in ((3,), (4, 4)):
        return [values]
    if not len(values) or values.shape[1:] not in ((3,), (4, 4)):
        raise ParameterError("pose", values.shape, "poses of shape (4, 4), or positions of shape (3,)")
    return list(values)


def _by_frame(waypoint: Any, frame: str | None) -> dict[str, Any]:
    """Return the poses of a waypoint by the names of their frames.

    Raises:
        ParameterError: No frame is named, or two.
    """
    if isinstance(waypoint, Mapping):
        if not waypoint:
            raise ParameterError("pose", waypoint, "a pose for a frame")
        for name, pose in waypoint.items():
            if isinstance(pose, PoseTarget) and pose.frame != name:
                raise ParameterError(f"pose of {name}", pose.frame, "a pose of that frame")
        return dict(waypoint)
    if isinstance(waypoint, PoseTarget):
        if frame not in (None, waypoint.frame):
            raise ParameterError("frame", frame, f"{waypoint.frame!r}, the frame of the pose")
        return {waypoint.frame: waypoint}
    if frame is None:
        raise ParameterError("frame", frame, "the name of a hand, a link or a held object")
    return {frame: waypoint}


def _matrix(pose: Any, before: Array, axial: bool, name: str) -> Array:
    """Return a pose as a rigid transform, shape (4, 4).

    Args:
        pose: The pose.
        before: The one before it, whose orientation one without any keeps.
        axial: Whether the z axis alone counts of a quaternion: the shortest turn leads to it.
        name: What it is called in errors.

    Raises:
        ParameterError: It is no rigid pose.
    """
    made = before.copy()
    if isinstance(pose, PoseTarget):
        if not pose.is_exact or pose.free_turn is not None:
            raise ParameterError(name, pose, "one pose, without free_turn, lower and upper")
        made[:3, 3] = pose.position
        if pose.orientation is not None:
            wanted = pose_matrix(pose.position, pose.orientation)[:3, :3]
            if axial:
                wanted = pin.Quaternion.FromTwoVectors(before[:3, 2], wanted[:, 2]).matrix() @ before[:3, :3]
            made[:3, :3] = wanted
        return made
    values = finite_array(pose, name)
    if values.shape == (3,):
        made[:3, 3] = values
        return made
    return rigid_pose(values, name)


def _in_both_hands(checker: CollisionChecker, tools: tuple[Tool, ...], q: Array) -> tuple[tuple[Tool, ...], list[int]]:
    """Return tools with one more for each object that two links hold, one of them moved by a tool.

    It is fixed to the other link, and where the tool is at the start; so both keep their relative pose where they have
    the same poses.

    Args:
        checker: Collision checker with the held objects.
        tools: The tools.
        q: The start, shape (dof,).

    Returns:
        The tools, and the numbers of the tools that the additional ones go with.

    Raises:
        ParameterError: Both links have tools already.
    """
    robot, found, sources = checker.robot, list(tools), list[int]()
    for held in checker.held.values():
        arms = [(link, set(_arm(robot, link))) for link in held.links or ()]
        moving = [[f for f, tool in enumerate(tools) if arm & set(tool.columns.tolist())] for _, arm in arms]
        if all(moving) and moving:
            given = " and ".join(tools[f].name for f in sorted({side[0] for side in moving}))
            raise ParameterError("pose", f"poses of {given}", f"one frame, as two links hold {held.name!r}")
        for (link, _), mine, other in zip(arms, moving, moving[::-1], strict=True):
            if mine or not other:
                continue
            tool = tools[other[0]]
            rotation, point = (x[0, other[0]] for x in Tools(checker.kernel, tools).poses(q[None]))
            placed = np.eye(4)
            placed[:3, :3], placed[:3, 3] = rotation, point
            inside = np.linalg.inv(robot.link_pose(q, link)) @ placed
            found.append(_tool(robot, f"{tool.name} in {link}", link, inside))
            sources.append(other[0])
    return tuple(found), sources


def _arm(robot: Robot, link: str) -> list[int]:
    """Return the planned joints that move a link, those of the hands left out."""
    links, synergies = Links.of(robot), {hand.synergy for hand in robot.hands.values()}
    joint, _ = links.frame(link, pin.SE3.Identity())
    return [k for k in links.moved(joint) if robot.joint_names[k] not in synergies]


def _tool(robot: Robot, name: str, link: str, pose: Array) -> Tool:
    """Return the tool that is a frame with a pose in that of a link, shape (4, 4) [m]."""
    joint, placed = Links.of(robot).frame(link, pin.SE3(pose))
    return Tool(name, joint, np.array(placed.homogeneous), np.array(_arm(robot, link), np.intp))
