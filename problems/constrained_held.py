"""What the hands carry under constraints: a tray in both hands, alone or with a cup on it, or an upright cup in each.

A tray is held at its two ends, between the palms, whose fingers point forward and down. Its frame has x away from the
robot, y from the right hand to the left one, and z out of its upper face. Lengths are in meters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from apex_ompl.goals.grasp import close_hands
from apex_ompl.problems.broad_tasks import Held
from apex_ompl.problems.objects import cup
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import AttachedObject, pose_fields
from apex_ompl.scene.constraints import Upright
from apex_ompl.types import Array

TRAY, LEVEL, CUPS = "tray", "level", "cups"
KINDS = (TRAY, LEVEL, CUPS)
LEVEL_ANGLE = 0.01  # largest angle between the tray's normal and up on `level` [rad]
CUP_ANGLE = 0.1  # largest angle between the axis of a cup and up [rad]
SYNERGY = 0.5  # of hands that hold a tray
HALF_LENGTHS = (0.16, 0.2, 0.24)  # from the middle of a tray to its ends [m]
DEPTHS = (0.2, 0.26, 0.32)  # of trays [m]
PITCHES = (0.3, 0.6, 0.9)  # of the fingers below the plane of the tray [rad]
THICKNESS = 0.02  # of trays [m]
CARGO_RADIUS, CARGO_LENGTH = 0.035, 0.12  # of the cup on a tray [m]
CARGO_GAP = 1e-3  # between the cup and the tray [m]
SIDES = (1.0, -1.0)  # y of the ends of a tray that the left and the right hand hold


@dataclass(frozen=True)
class TraySize:
    """Measures of a tray and its grasp.

    Attributes:
        half_length: From its middle to either end [m].
        depth: [m].
        pitch: Of the fingers below its plane [rad].
    """

    half_length: float
    depth: float
    pitch: float

    def palm(self, side: int) -> Array:
        """Return the pose of the left (0) or the right (1) palm in the frame of the tray, shape (4, 4) [m]."""
        hand = tuple(robot().hands.values())[side]
        fingers = np.array([np.cos(self.pitch), 0.0, -np.sin(self.pitch)])
        outward = np.array([0.0, SIDES[side], 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(fingers, outward), fingers, outward], axis=1)
        pose[:3, 3] = SIDES[side] * np.array([0.0, self.half_length, 0.0]) - pose[:3, :3] @ hand.point
        return pose


@dataclass(frozen=True, eq=False)
class Carried:
    """What both hands carry.

    Attributes:
        held: The objects with the robot's tables.
        constraints: What holds along a path, beside the chain that a tray closes.
        tray: Measures of the tray; None for cups.
    """

    held: Held
    constraints: tuple[Upright, ...] = ()
    tray: TraySize | None = None


def draw_carried(rng: np.random.Generator, kind: str) -> Carried:
    """Draw what is carried on a level of constrained problems: a tray of some size, or the cups."""
    if kind == CUPS:
        return held_cups()
    half_length, depth, pitch = (float(rng.choice(some)) for some in (HALF_LENGTHS, DEPTHS, PITCHES))
    return carried_tray(TraySize(half_length, depth, pitch), loaded=kind == LEVEL)


@cache
def carried_tray(size: TraySize, *, loaded: bool) -> Carried:
    """Return a tray in both hands, with a cup on it where it is ``loaded``."""
    left, right = robot().hands.values()
    in_palm = np.asarray(np.linalg.inv(size.palm(0)), float)
    box = (size.depth, 2.0 * size.half_length, THICKNESS)
    tray = {"name": "tray", "box": box, "links": (left.palm, right.palm), **_rounded(in_palm)}
    bodies = [AttachedObject.model_validate(tray)]
    if loaded:
        pose = np.eye(4)
        pose[:3, 3] = 0.0, 0.25 * size.half_length, (THICKNESS + CARGO_LENGTH) / 2.0 + CARGO_GAP
        cylinder = {"radius": CARGO_RADIUS, "length": CARGO_LENGTH}
        cargo = {"name": "cargo", "cylinder": cylinder, "link": left.palm, "touch_links": ()}
        bodies.append(AttachedObject.model_validate({**cargo, **_rounded(in_palm @ pose)}))
    upright = (Upright(frame="tray", angle=LEVEL_ANGLE),) if loaded else ()
    return Carried(Held.of(bodies, (SYNERGY,) * 2, (SYNERGY,) * 2), upright, size)


@cache
def held_cups() -> Carried:
    """Return a cup for each hand; their openings are on the side of the thumbs."""
    objects = [("left_hand", cup("left_cup", 1)), ("right_hand", cup("right_cup", -1))]
    attached, home, _ = close_hands(robot(), objects)
    synergies = home[robot().groups["hands"]].tolist()
    upright = tuple(Upright(frame=body.name, angle=CUP_ANGLE) for body in attached)
    return Carried(Held.of(attached, synergies, synergies), upright)


def upright_palm(side: int, fingers: Array) -> Array:
    """Return the orientation of a palm whose cup stands upright.

    Args:
        side: 0 for the left hand, 1 for the right one.
        fingers: Level unit direction of the fingers in the world, shape (3,).

    Returns:
        Shape (3, 3).
    """
    x = SIDES[side] * np.array([0.0, 0.0, 1.0])  # the thumb's side of the left palm, the other one of the right
    return np.stack([x, fingers, np.cross(x, fingers)], axis=1)


def _rounded(pose: Array) -> Mapping[str, tuple[float, ...]]:
    """Return the fields of a pose with lengths rounded to a micrometer; the orientation is not rounded."""
    fields = pose_fields(pose)
    return MappingProxyType({**fields, "position": tuple(round(v, 6) for v in fields["position"])})
