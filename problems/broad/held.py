"""Random held objects: pins, boxes, balls, pegs, bars, trays, angles and cups, in the frame of a palm.

An object lies on the palm, and the fingers close on it until just before they touch; the hand that holds it may touch
it. The start keeps the fingers so, and so does the goal.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import SceneError
from apex_ompl.goals.grasp import grasp
from apex_ompl.goals.state_sampling import DualArmTables
from apex_ompl.problems.objects import ALONG_X, PALM, cup
from apex_ompl.problems.suite_robot import empty_hand_tables, robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array

NONE_HELD, ONE_HELD = 0.45, 0.3  # shares of problems with empty hands, and with an object in one
OPEN = (0.0, 0.4)  # interval of the synergies of empty hands
SYNERGY_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Held:
    """Held objects, and the robot with them.

    Attributes:
        attached: The objects.
        tables: The kernel's tables of the robot with the objects: of both arms, and of each alone.
        low: Least synergy of each hand, shape (2,).
        high: Largest one, the same for a hand that holds something, shape (2,).
    """

    attached: tuple[AttachedObject, ...]
    tables: DualArmTables
    low: Array
    high: Array

    @classmethod
    def of(cls, attached: Sequence[AttachedObject], low: Sequence[float], high: Sequence[float]) -> Held:
        """Return held objects with the tables of the robot that holds them."""
        bare = empty_hand_tables()
        tables = bare
        if attached:
            both = CollisionChecker(robot(), (), attached).kernel.robot
            tables = DualArmTables(
                bare.robot, both, (both.restricted_to(bare.joints[0]), both.restricted_to(bare.joints[1])), bare.joints
            )
        return cls(tuple(attached), tables, np.array(low, float), np.array(high, float))


def draw_held(rng: np.random.Generator) -> Held:
    """Draw what both hands hold: nothing in about half of the problems, else an object in one hand or in both."""
    share = rng.random()
    sides = (0, 1) if share >= NONE_HELD + ONE_HELD else (int(rng.integers(2)),) if share >= NONE_HELD else ()
    attached, low, high = list[AttachedObject](), [OPEN[0]] * 2, [OPEN[1]] * 2
    for side in sides:
        kind = list(KINDS)[int(rng.integers(len(KINDS)))]
        bodies, synergy = _grasped(kind, tuple(np.round(rng.uniform(size=4), 2).tolist()), side)
        attached += bodies
        if bodies:
            low[side] = high[side] = synergy
    return Held.of(attached, low, high)


@lru_cache(maxsize=256)
def _grasped(kind: str, shares: tuple[float, ...], side: int) -> tuple[tuple[AttachedObject, ...], float]:
    """Return the bodies of an object in a hand, and the synergy that holds them; none where the hand is too small."""
    hand = ("left_hand", "right_hand")[side]
    bodies, synergy = list[AttachedObject](), 1.0
    for k, fields in enumerate(KINDS[kind](*shares)):
        if "cup" in fields:
            body = cup(hand.replace("hand", "cup"), -1 if side == 0 else 1)
        else:
            body = AttachedObject.model_validate({"name": f"{hand}_{kind}_{k}", "link": "palm", **fields})
        try:
            closed = grasp(robot(), hand, body)
        except SceneError:
            return (), 0.0
        bodies.append(closed.held.model_copy(update={"touch_links": None}))
        synergy = min(synergy, closed.synergy)
    return tuple(bodies), float(np.floor(synergy / SYNERGY_STEP) * SYNERGY_STEP)


def _scaled(share: float, low: float, high: float) -> float:
    """Return the length at a share of an interval [m], in tenths of millimeters."""
    return round(low + share * (high - low), 4)


def _pin(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius, length = _scaled(u, 0.003, 0.008), _scaled(v, 0.05, 0.14)
    pose = {"position": (_scaled(w, -0.04, 0.04), _scaled(x, 0.02, 0.05), PALM - radius), "orientation": ALONG_X}
    return [{"cylinder": {"radius": radius, "length": length}, **pose}]


def _box(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    size = (_scaled(u, 0.03, 0.14), _scaled(v, 0.03, 0.12), _scaled(w, 0.02, 0.07))
    return [{"box": size, "position": (0.0, _scaled(x, 0.02, 0.06), PALM - size[2] / 2)}]


def _ball(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius = _scaled(u, 0.012, 0.045)
    return [{"sphere": {"radius": radius}, "position": (_scaled(v, -0.03, 0.03), 0.03, PALM - radius)}]


def _peg(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius, length = _scaled(u, 0.01, 0.03), _scaled(v, 0.1, 0.2)
    pose = {"position": (_scaled(w, -0.05, 0.05), 0.03, PALM - radius), "orientation": ALONG_X}
    return [{"cylinder" if x < 0.6 else "capsule": {"radius": radius, "length": length}, **pose}]


def _bar(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    radius, length = _scaled(u, 0.006, 0.018), _scaled(v, 0.22, 0.4)
    offset = _scaled(w, -0.3, 0.3) * length
    pose = {"position": (round(offset, 4), 0.03, PALM - radius), "orientation": ALONG_X}
    if x < 0.3:
        return [{"box": (2 * radius, 2 * radius, length), **pose}]
    return [{"cylinder": {"radius": radius, "length": length}, **pose}]


def _tray(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    size = (_scaled(u, 0.15, 0.3), _scaled(v, 0.12, 0.3), _scaled(w, 0.006, 0.02))
    return [{"box": size, "position": (0.0, round(0.03 + size[1] / 2 * x, 4), PALM - size[2] / 2)}]


def _angle(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    """An L or a T of two bars: one across the palm, one off it at an end or in the middle."""
    thick, length, arm = _scaled(u, 0.014, 0.03), _scaled(v, 0.12, 0.3), _scaled(w, 0.08, 0.22)
    end = length / 2 - thick / 2 if x < 0.6 else 0.0
    across = {"box": (length, thick, thick), "position": (0.0, 0.03, PALM - thick / 2)}
    off = {"box": (thick, thick, arm), "position": (round(end, 4), 0.03, round(PALM - thick - arm / 2, 4))}
    return [across, off]


def _cup(u: float, v: float, w: float, x: float) -> list[dict[str, Any]]:
    return [{"cup": True}]


KINDS: dict[str, Callable[[float, float, float, float], list[dict[str, Any]]]] = {
    "pin": _pin, "box": _box, "ball": _ball, "peg": _peg, "bar": _bar, "tray": _tray, "angle": _angle, "cup": _cup,
}  # fmt: skip
"""Kinds of objects: the fields of their bodies for four numbers from 0 to 1."""
