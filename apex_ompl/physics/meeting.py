"""Whether objects as they lie in the hands can be brought together at all, whatever the arms do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from apex_ompl.collision import CollisionChecker
from apex_ompl.drivers.grasps import hands_of
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import HOLDING, AttachedObject, Obstacle, given_fields, pose_fields
from apex_ompl.scene.steps import LineStep, Step
from apex_ompl.types import Array

SPARE = 0.0015  # by which the objects go further than the line [m]
TURNS = 24  # about the common axis of the faces


def can_meet(robot: Robot, start: Array, held: Sequence[AttachedObject], steps: Sequence[Step]) -> bool:
    """Whether hands leave room for what lines bring onto the faces of the objects that they hold.

    At some turn about the common axis of the faces, no hand may touch the object of the other hand, even where that is
    ``SPARE`` further along the axis. Arms, obstacles and planners have no part in it.

    Args:
        robot: The robot.
        start: State whose hands are closed on the objects, shape (dof,).
        held: The objects where they are in the hands.
        steps: The steps of the task.
    """
    named = {one.name: one for one in held if one.contact is not None and hands_of(robot, one)}
    for step in steps:
        if isinstance(step, LineStep) and step.distance is not None and {step.frame[0], step.onto} <= named.keys():
            moved, onto = named[step.frame[0]], named[str(step.onto)]
            if not any(
                _leaves_room(robot, start, onto, moved, together)
                and _leaves_room(robot, start, moved, onto, np.asarray(np.linalg.inv(together), float))
                for together in _together(onto, moved, step.distance - SPARE)
            ):
                return False
    return True


def _together(onto: AttachedObject, moved: AttachedObject, distance: float) -> list[Array]:
    """Return poses of an object in the frame of the one onto whose face it is brought, shape (4, 4) [m]."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    found = []
    for angle in np.arange(TURNS) * 2.0 * np.pi / TURNS:
        between = np.eye(4)
        between[:3, :3], between[2, 3] = pin.utils.rotate("z", angle), distance
        found.append(_face(onto) @ between @ flip @ np.linalg.inv(_face(moved)))
    return found


def _face(one: AttachedObject) -> Array:
    """Return the pose of the contact face in the frame of the object, with its axis as z, shape (4, 4) [m]."""
    assert one.contact is not None
    pose, axis = np.eye(4), np.asarray(one.contact.axis, float)
    pose[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis / np.linalg.norm(axis)).matrix()
    pose[:3, 3] = one.contact.point
    return pose


def _leaves_room(robot: Robot, start: Array, held: AttachedObject, other: AttachedObject, pose: Array) -> bool:
    """Whether the hand that holds an object touches nothing of another one at a pose in the frame of the former."""
    world = robot.link_pose(start, held.link) @ held.pose @ pose
    there = Obstacle.model_validate({**given_fields(other, HOLDING), **pose_fields(world)})
    links = {link for hand in hands_of(robot, held) for link in robot.hand_of(robot.hands[hand].palm)}
    contacts = CollisionChecker(robot, [there]).contacts(start)
    return not any(other.name in (one.first, one.second) and links & {one.first, one.second} for one in contacts)
