"""Frames fixed to the links of a robot, by name: of hands, links and held objects, and contact faces of these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.errors import UnknownNameError
from apex_ompl.kernel.products import product
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import WorldVector
from apex_ompl.types import Array
from apex_ompl.util.arrays import length

OPPOSITE = 1e-9  # least 1 + cosine between an axis and another one that it is turned to by the shortest turn


class Frame(NamedTuple):
    """A frame fixed to a link.

    Attributes:
        link: The link.
        pose: Pose in the link's frame, shape (4, 4) [m].
        axial: Whether it is a contact face, which only has a z axis.
    """

    link: str
    pose: Array
    axial: bool


@dataclass(frozen=True)
class LinkFace:
    """A contact face fixed to a link.

    Attributes:
        link: The link.
        point: Center of the face in the link's frame, shape (3,) [m].
        axis: Outward unit axis in the link's frame, shape (3,).
    """

    link: str
    point: Array
    axis: Array

    @classmethod
    def of_object(cls, held: AttachedObject) -> LinkFace:
        """Return the contact face of a held object."""
        assert held.contact is not None
        pose = held.pose
        axis = pose[:3, :3] @ np.asarray(held.contact.axis, float)
        point = pose[:3, :3] @ np.asarray(held.contact.point, float) + pose[:3, 3]
        return cls(held.link, point, axis / length(axis))

    @classmethod
    def of_vector(cls, robot: Robot, vector: WorldVector, start: Array) -> LinkFace:
        """Return the face given by a vector in the world, fixed to its link at the state ``start``.

        Raises:
            UnknownNameError: No such link.
        """
        pose = robot.link_pose(start, vector.link)
        tail, tip = np.asarray(vector.tail, float), np.asarray(vector.tip, float)
        axis = pose[:3, :3].T @ (tip - tail)
        return cls(vector.link, pose[:3, :3].T @ (tip - pose[:3, 3]), axis / length(axis))

    @classmethod
    def of_hand(cls, robot: Robot, name: str) -> LinkFace:
        """Return the grasp point of a hand with the outward normal of its palm.

        Raises:
            UnknownNameError: No such hand.
        """
        if name not in robot.hands:
            raise UnknownNameError("hand", name, robot.hands)
        hand = robot.hands[name]
        return cls(hand.palm, np.asarray(hand.point, float), np.asarray(hand.axis, float))


def holding_link(robot: Robot, name: str) -> str:
    """Return the link that holds what a hand or a link takes: the palm of the hand, or the link itself."""
    return robot.hands[name].palm if name in robot.hands else name


def holding_hand(robot: Robot, link: str) -> str | None:
    """Return the hand that a link belongs to, or None."""
    return next((name for name, hand in robot.hands.items() if link in robot.hand_of(hand.palm)), None)


def frame_of(robot: Robot, name: str, held: Mapping[str, AttachedObject], role: str = "frame") -> Frame:
    """Return the frame of a hand, a link or a held object by name.

    That of a hand is that of its palm with the grasp point as origin. That of a held object is its own; where it has a
    contact face, the origin is the center of the face, and the axes are turned by the shortest turn that brings z to
    the outward axis, which is half a turn about x where that is -z.

    Raises:
        UnknownNameError: There is no such frame; ``role`` says what was looked for.
    """
    if name in held:
        if held[name].contact is None:
            return Frame(held[name].link, held[name].pose, axial=False)
        face, pose = LinkFace.of_object(held[name]), held[name].pose
        pose[:3, :3] = _turned(pose[:3, :3], face.axis)
        pose[:3, 3] = face.point
        return Frame(face.link, pose, axial=True)
    if name in robot.hands:
        hand, pose = robot.hands[name], np.eye(4)
        pose[:3, 3] = hand.point
        return Frame(hand.palm, pose, axial=False)
    if name in robot.link_names:
        return Frame(name, np.eye(4), axial=False)
    raise UnknownNameError(role, name, (*robot.hands, *held, *robot.link_names))


def _turned(axes: Array, axis: Array) -> Array:
    """Return axes, shape (3, 3), turned so that the last one is a unit axis, shape (3,)."""
    if 1.0 + float((axes[:, 2] * axis).sum()) < OPPOSITE:
        return np.array(axes * (1.0, -1.0, -1.0))
    return product(pin.Quaternion.FromTwoVectors(axes[:, 2], axis).matrix(), axes)
