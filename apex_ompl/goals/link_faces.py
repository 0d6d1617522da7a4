"""Contact faces fixed to links: of held objects, of vectors in the world, and of hands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.errors import UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import WorldVector
from apex_ompl.types import Array
from apex_ompl.util.arrays import length


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


def lip_direction(vessel: AttachedObject) -> Array | None:
    """Return the unit direction from the axis of a vessel to its lip, in the link's frame, shape (3,).

    It is the part of the contact point across the contact axis; None where the point lies on the axis.
    """
    assert vessel.contact is not None
    axis = np.asarray(vessel.contact.axis, float)
    axis = axis / length(axis)
    point = np.asarray(vessel.contact.point, float)
    across = vessel.pose[:3, :3] @ (point - float((axis * point).sum()) * axis)
    size = length(across)
    return across / size if size > 1e-6 else None
