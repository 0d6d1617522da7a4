"""Goals of hands at grasps of objects, and of several arms together, as alternatives of poses."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from apex_ompl.errors import FileFormatError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import pose_fields
from apex_ompl.scene.problem import Goal, GraspGoal, PoseTarget, Problem
from apex_ompl.types import Array

MOST = 512  # alternatives of one goal; of more combinations every n-th one is taken

Poses = tuple[PoseTarget, ...]
"""Poses that are reached together."""


def pose_alternatives(robot: Robot, problem: Problem, goal: Goal) -> list[Poses]:
    """Return alternatives of poses, any of which reaches a goal.

    Args:
        robot: The robot.
        problem: The problem, at whose start objects are where they are grasped.
        goal: A goal of poses, grasps, any of these, or all of these.

    Raises:
        FileFormatError: An object is unknown or has no grasp for the hand, or poses are given twice for a frame.
    """
    if goal.poses is not None:
        return [goal.poses]
    if goal.grasp is not None:
        return _grasps(robot, problem, goal.grasp)
    if goal.any_of is not None:
        return [one for member in goal.any_of for one in pose_alternatives(robot, problem, member)]
    parts = [pose_alternatives(robot, problem, member) for member in goal.all_of or ()]
    count = int(np.prod([len(part) for part in parts]))
    rows = list(product(*parts)) if count <= MOST else _spread(parts)
    found = [tuple(pose for part in row for pose in part) for row in rows]
    frames = [pose.frame for pose in found[0]] if found else []
    if len(set(frames)) < len(frames):
        raise FileFormatError(problem.source, "goal.all_of", ", ".join(frames), "expected poses of different frames")
    return found


def _spread(parts: Sequence[Sequence[Poses]]) -> list[tuple[Poses, ...]]:
    """Return ``MOST`` combinations in which each alternative of each part occurs about equally often."""
    rng = np.random.default_rng(0)
    columns = [np.resize(rng.permutation(len(part)), MOST) for part in parts]
    orders = [rng.permutation(column) for column in columns]
    return [tuple(part[k] for part, k in zip(parts, row, strict=True)) for row in zip(*orders, strict=True)]


def _grasps(robot: Robot, problem: Problem, goal: GraspGoal) -> list[Poses]:
    """Return the poses of a hand at the grasps of an object.

    Raises:
        FileFormatError: The object is unknown, or has none for the hand.
    """
    body = next((one for one in (*problem.scene, *problem.attached) if one.name == goal.object), None)
    if body is None:
        known = ", ".join(one.name for one in (*problem.scene, *problem.attached)) or "there is none"
        raise FileFormatError(problem.source, "goal.grasp.object", goal.object, f"expected an object: {known}")
    if goal.hand not in robot.hands:
        known = ", ".join(robot.hands) or "the robot has none"
        raise FileFormatError(problem.source, "goal.grasp.hand", goal.hand, f"expected a hand: {known}")
    grasps = [one for one in body.grasps if one.hand in (None, goal.hand)]
    if not grasps:
        expected = f"expected an object with grasps for {goal.hand}"
        raise FileFormatError(problem.source, "goal.grasp.object", goal.object, expected)
    place: Array = body.pose
    link = getattr(body, "link", None)
    if link is not None:
        place = robot.link_pose(problem.start_state(robot.joint_names), link) @ place
    found = list[Poses]()
    for one in grasps:
        pose = place @ one.pose
        if goal.remaining is not None:
            pose[:3, 3] -= pose[:3, :3] @ np.asarray(goal.remaining, float)
        found.append((PoseTarget.model_validate({"frame": goal.hand, **pose_fields(pose)}),))
    return found
