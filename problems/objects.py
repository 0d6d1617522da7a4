"""Objects that the hands hold, with poses in the frame of the palm, and obstacles of generated scenes.

Numbers of obstacles are rounded to a tenth of a millimeter.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.goals.grasp import HandObjects
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.types import Array

DATA = Path(__file__).parent / "data"
PALM = -0.009  # z of the surface of an object that lies on the palm, in the palm's frame [m]
ALONG_X = (0.0, float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)))  # turns z to the palm's x


def _attached(**fields: Any) -> AttachedObject:
    return AttachedObject.model_validate(fields)


def boxes(thick: float = 0.07, tall: float = 0.14) -> HandObjects:
    """Return a box for each hand, its contact face on the side of the little finger.

    Args:
        thick: Edge of the square cross-section [m].
        tall: Length [m].
    """
    height = PALM - thick / 2
    base = {"link": "palm", "box": (thick, thick, tall), "position": (0.0, 0.02, height), "orientation": ALONG_X}
    faces = {"lower": (-tall / 2, -1), "upper": (tall / 2, 1)}
    return [
        (f"{side}_hand", _attached(name=name, contact={"point": (0, 0, z), "axis": (0, 0, axis)}, **base))
        for side, (name, (z, axis)) in zip(("left", "right"), faces.items(), strict=True)
    ]


def cup(name: str, side: int, **contact: object) -> AttachedObject:
    """Return the cup, its opening (the mesh's +z) on the little finger's side: -x for the left palm, +x for the right.

    Args:
        name: Name of the object.
        side: -1 for the left hand, 1 for the right one.
        **contact: Fields of its contact face that differ from the middle of the opening.
    """
    turn = ALONG_X if side > 0 else (0.0, -ALONG_X[1], 0.0, ALONG_X[3])
    return _attached(
        name=name, link="palm", mesh={"file": str(DATA / "cup.obj")}, position=(0.0, 0.02, PALM - 0.04),
        orientation=turn, contact={"point": (0, 0, 0.065), "axis": (0, 0, 1), **contact},
    )  # fmt: skip


def cup_and_ball() -> HandObjects:
    """Return a cup for the left hand, and a ball between the outer fingers of the right one."""
    ball = _attached(
        name="ball", link="palm", sphere={"radius": 0.032}, position=(0.035, 0.03, PALM - 0.032),
        contact={"point": (0.032, 0, 0), "axis": (1, 0, 0)},
    )  # fmt: skip
    return [("left_hand", cup("cup", -1)), ("right_hand", ball)]


def block_and_peg(mesh: str = "block.obj") -> HandObjects:
    """Return a block with a square hole for the left hand, and a round peg for the right one.

    Args:
        mesh: File of the block.
    """
    block = _attached(
        name="block", link="palm", mesh={"file": str(DATA / mesh)}, position=(-0.03, 0.03, PALM - 0.04),
        orientation=(0.0, -ALONG_X[1], 0.0, ALONG_X[3]), contact={"point": (0, 0, 0.035), "axis": (0, 0, 1)},
    )  # fmt: skip
    peg = _attached(
        name="peg", link="palm", cylinder={"radius": 0.016, "length": 0.18}, position=(0.02, 0.03, PALM - 0.016),
        orientation=ALONG_X, contact={"point": (0, 0, 0.09), "axis": (0, 0, 1)},
    )  # fmt: skip
    return [("left_hand", block), ("right_hand", peg)]


def two_cups() -> HandObjects:
    """Return a full cup for the right hand, its lip away from the palm, and an empty one for the left hand.

    The contact face of the full one is 20 mm before its lip, where what flows out slowly falls.
    """
    # In the turned cup the -x axis of the mesh points along +z of the palm: +x is the side away from the palm.
    return [("left_hand", cup("empty", -1)), ("right_hand", cup("full", 1, point=(0.04, 0, 0.085)))]


def bar() -> HandObjects:
    """Return a bar for the left hand; it extends beyond the little finger, where the right hand is to grasp it."""
    held = _attached(
        name="bar", link="palm", cylinder={"radius": 0.015, "length": 0.36}, position=(-0.1, 0.03, PALM - 0.015),
        orientation=ALONG_X, contact={"point": (0.015, 0, -0.13), "axis": (1, 0, 0)},
    )  # fmt: skip
    return [("left_hand", held)]


def parcels() -> HandObjects:
    """Return a parcel for each hand, along the fingers."""
    base = {"link": "palm", "box": (0.07, 0.12, 0.06), "position": (0.0, 0.06, PALM - 0.03)}
    return [(f"{side}_hand", _attached(name=f"{side}_parcel", **base)) for side in ("left", "right")]


def box(name: str, size: Sequence[float], position: Sequence[float]) -> Obstacle:
    """Return an upright box of edges ``size`` [m] centered at ``position`` [m]."""
    return _obstacle(name=name, box=_rounded(size), position=_rounded(position))


def upright_bar(name: str, radius: float, length: float, position: Sequence[float]) -> Obstacle:
    """Return an upright cylinder centered at ``position`` [m]; ``length`` is not rounded."""
    cylinder = {"radius": _rounded([radius])[0], "length": length}
    return _obstacle(name=name, cylinder=cylinder, position=_rounded(position))


def _obstacle(**fields: Any) -> Obstacle:
    return Obstacle.model_validate(fields)


def _rounded(numbers: Iterable[float]) -> tuple[float, ...]:
    return tuple(round(float(v), 4) for v in numbers)


def primitive(name: str, kind: int, size: Array, position: Array, quaternion: Array) -> Obstacle:
    """Return a box, a ball, a cylinder or a capsule.

    Args:
        name: Name of the obstacle.
        kind: 0 to 3, in the order above.
        size: Edges of a box; the first one is the diameter of the others, the third one their length, shape (3,) [m].
        position: Center, shape (3,) [m].
        quaternion: Orientation as xyzw, of any norm but 0, shape (4,).
    """
    width, _, length = _rounded(size)
    shapes: tuple[dict[str, Any], ...] = (
        {"box": _rounded(size)}, {"sphere": {"radius": width / 2}},
        {"cylinder": {"radius": width / 2, "length": length}}, {"capsule": {"radius": width / 2, "length": length}},
    )  # fmt: skip
    unit = np.round(quaternion / np.linalg.norm(quaternion), 6)
    return _obstacle(name=name, **shapes[kind], position=_rounded(position), orientation=tuple(float(v) for v in unit))
