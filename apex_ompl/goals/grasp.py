"""Grasps: a held object with the hand synergy that closes on it and the links that may touch it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from apex_ompl.collision.mesh_stage import exact_requests
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.errors import SceneError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.robot.model import link_of
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array
from apex_ompl.util.display import fields_line

HandObjects = Sequence[tuple[str, AttachedObject]]
"""Objects by the name of the hand that is to hold each."""

SCAN = 200  # number of steps from open to closed before bisection
TOLERANCE = 1e-4  # of the synergy at first contact


@dataclass(frozen=True)
class Grasp:
    """An object in a hand.

    Attributes:
        held: The object, fixed to the palm; it may touch the links of the hand.
        hand: Name of the hand.
        synergy_joint: The joint that closes the hand, or None for a hand without one.
        synergy: Largest synergy found without contact.
        touched: The finger link that makes contact first, or an empty string when none does.
    """

    held: AttachedObject
    hand: str
    synergy_joint: str | None
    synergy: float
    touched: str

    __repr__ = fields_line


def grasp(robot: Robot, hand: str, held: AttachedObject) -> Grasp:
    """Close a hand on an object until just before a finger link makes contact.

    Args:
        robot: The robot.
        hand: Name of one of its hands.
        held: The object, posed in the frame of the hand's palm; its ``link`` and ``touch_links`` are set here.

    Raises:
        UnknownNameError: No such hand.
        SceneError: A finger of the open hand is in contact already.
    """
    if hand not in robot.hands:
        raise UnknownNameError("hand", hand, robot.hands)
    record = robot.hands[hand]
    links = robot.hand_of(record.palm)
    held = held.model_copy(update={"link": record.palm, "touch_links": links})
    if record.synergy is None:
        return Grasp(held, hand, None, 0.0, "")
    closing = _Closing(robot, held, record.synergy, links)
    low = 0.0
    touched = closing.touched(low)
    if touched:
        raise SceneError(f"the open {hand} does not clear {held.name!r}: {touched} is inside it")
    for high in np.linspace(0.0, 1.0, SCAN + 1)[1:]:
        touched = closing.touched(float(high))
        if touched:
            break
        low = float(high)
    else:
        return Grasp(held, hand, record.synergy, 1.0, "")
    high = float(high)
    while high - low > TOLERANCE:
        middle = (low + high) / 2
        found = closing.touched(middle)
        low, high, touched = (low, middle, found) if found else (middle, high, touched)
    return Grasp(held, hand, record.synergy, low, touched)


def close_hands(robot: Robot, objects: HandObjects) -> tuple[tuple[AttachedObject, ...], Array, list[Grasp]]:
    """Close hands on objects, see :func:`grasp`; synergies are rounded down to a thousandth.

    Returns:
        The held objects, the home state with the synergies that hold them, shape (dof,), and the grasps.
    """
    home, grasps = robot.home.copy(), [grasp(robot, hand, held) for hand, held in objects]
    for closed in grasps:
        if closed.synergy_joint:
            home[robot.joint_names.index(closed.synergy_joint)] = np.floor(closed.synergy * 1e3) / 1e3
    # The default touch links, those of the hand, are the same and keep problem files short.
    attached = tuple(closed.held.model_copy(update={"touch_links": None}) for closed in grasps)
    return attached, home, grasps


class _Closing:
    """Contact between the fingers of a hand and an object in its palm, as a function of the synergy."""

    def __init__(self, robot: Robot, held: AttachedObject, synergy: str, links: tuple[str, ...]) -> None:
        self.robot = robot
        self.index = robot.joint_names.index(synergy)
        palm = robot.model.frames[robot.link_frame(held.link)]
        self.geometry = pin.GeometryModel()
        fingers = [
            item
            for item in robot.geometry.geometryObjects
            if link_of(robot.model, item) in links and item.parentJoint != palm.parentJoint
        ]
        self.names = [link_of(robot.model, item) for item in fingers]
        shape: coal.CollisionGeometry = coal_geometry(held)
        placement = palm.placement * pin.SE3(held.pose)
        body = self.geometry.addGeometryObject(
            pin.GeometryObject(held.name, palm.parentJoint, robot.link_frame(held.link), placement, shape)
        )
        for item in fingers:
            self.geometry.addCollisionPair(pin.CollisionPair(self.geometry.addGeometryObject(item.copy()), body))
        self.data, self.geometry_data = robot.model.createData(), exact_requests(self.geometry.createData())

    def touched(self, synergy: float) -> str:
        """Return a finger link that overlaps the object at a synergy, or an empty string."""
        q = self.robot.home.copy()
        q[self.index] = synergy
        order = self.robot.to_pinocchio(q)
        pin.computeCollisions(self.robot.model, self.data, self.geometry, self.geometry_data, order, False)
        hits = [r.isCollision() for r in self.geometry_data.collisionResults]
        return next((name for name, hit in zip(self.names, hits, strict=True) if hit), "")
