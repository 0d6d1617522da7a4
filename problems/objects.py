"""What the hands of the ready-made problems and of the suites hold, and how it is grasped."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.tasks.grasp import Grasp, grasp

Held = Sequence[tuple[str, AttachedObject]]

DATA = Path(__file__).parent / "data"
PALM = -0.009  # height of an object's surface over the palm, in the palm's frame [m]
ALONG_X = (0.0, float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)))  # turns z to the palm's x


def _made(**fields: Any) -> AttachedObject:
    return AttachedObject.model_validate(fields)


def boxes(thick: float = 0.07, tall: float = 0.14) -> Held:
    """Return a box for each hand, faces to be stacked on the side of the little finger [m]."""
    height = PALM - thick / 2
    base = {"link": "palm", "box": (thick, thick, tall), "position": (0.0, 0.02, height), "orientation": ALONG_X}
    faces = {"lower": (-tall / 2, -1), "upper": (tall / 2, 1)}
    return [
        (f"{side}_hand", _made(name=name, contact={"point": (0, 0, z), "axis": (0, 0, axis)}, **base))
        for side, (name, (z, axis)) in zip(("left", "right"), faces.items(), strict=True)
    ]


def cup(name: str, side: int, **contact: object) -> AttachedObject:
    """Return the cup, its opening (the mesh's +z) on the little finger's side: -x for the left palm, +x for the right.

    Args:
        name: Name of the object.
        side: -1 for the left hand, 1 for the right one.
        **contact: Parts of its contact face that are not the middle of the opening.
    """
    turn = ALONG_X if side > 0 else (0.0, -ALONG_X[1], 0.0, ALONG_X[3])
    return _made(
        name=name, link="palm", mesh={"file": str(DATA / "cup.obj")}, position=(0.0, 0.02, PALM - 0.04),
        orientation=turn, contact={"point": (0, 0, 0.065), "axis": (0, 0, 1), **contact},
    )  # fmt: skip


def cup_and_ball() -> Held:
    """Return a cup for the left hand, and a ball between the outer fingers of the right one."""
    ball = _made(
        name="ball", link="palm", sphere={"radius": 0.032}, position=(0.035, 0.03, PALM - 0.032),
        contact={"point": (0.032, 0, 0), "axis": (1, 0, 0)},
    )  # fmt: skip
    return [("left_hand", cup("cup", -1)), ("right_hand", ball)]


def block_and_peg() -> Held:
    """Return a block with a square hole for the left hand, and a round peg for the right one."""
    block = _made(
        name="block", link="palm", mesh={"file": str(DATA / "block.obj")}, position=(-0.03, 0.03, PALM - 0.04),
        orientation=(0.0, -ALONG_X[1], 0.0, ALONG_X[3]), contact={"point": (0, 0, 0.035), "axis": (0, 0, 1)},
    )  # fmt: skip
    peg = _made(
        name="peg", link="palm", cylinder={"radius": 0.016, "length": 0.18}, position=(0.02, 0.03, PALM - 0.016),
        orientation=ALONG_X, contact={"point": (0, 0, 0.09), "axis": (0, 0, 1)},
    )  # fmt: skip
    return [("left_hand", block), ("right_hand", peg)]


def two_cups() -> Held:
    """Return a full cup for the right hand, its lip away from the palm, and an empty one for the left hand."""
    # Of the turned cup, -x of the mesh looks along +z of the palm, so +x is the side away from the palm.
    return [("left_hand", cup("empty", -1)), ("right_hand", cup("full", 1, point=(0.04, 0, 0.065)))]


def bar() -> Held:
    """Return a bar for the left hand that sticks out beyond the little finger, where the right hand is to take it."""
    held = _made(
        name="bar", link="palm", cylinder={"radius": 0.015, "length": 0.36}, position=(-0.1, 0.03, PALM - 0.015),
        orientation=ALONG_X, contact={"point": (0.015, 0, -0.13), "axis": (1, 0, 0)},
    )  # fmt: skip
    return [("left_hand", held)]


def parcels() -> Held:
    """Return a parcel for each hand, along the fingers."""
    base = {"link": "palm", "box": (0.07, 0.12, 0.06), "position": (0.0, 0.06, PALM - 0.03)}
    return [(f"{side}_hand", _made(name=f"{side}_parcel", **base)) for side in ("left", "right")]


def put_in_hands(robot: Robot, held: Held) -> tuple[tuple[AttachedObject, ...], NDArray[np.float64], list[Grasp]]:
    """Close the hands on what they hold.

    Returns:
        The objects, the home state with the synergies that hold them, shape (dof,), and the grasps.
    """
    home, grasps = robot.home.copy(), [grasp(robot, hand, item) for hand, item in held]
    for closed in grasps:
        if closed.synergy_joint:
            home[robot.joint_names.index(closed.synergy_joint)] = np.floor(closed.synergy * 1e3) / 1e3
    # The default touch links, those of the hand, are the same and keep the files short.
    objects = tuple(closed.held.model_copy(update={"touch_links": None}) for closed in grasps)
    return objects, home, grasps
