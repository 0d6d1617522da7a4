"""Scenes in which both hands carry one tray: shelf, wall, posts and clutter, with the poses of the tray at both ends.

They stand for the scenes of :mod:`apex_ompl.problems.scenes`, which hands pass one by one; cups go through those. The
frame of a tray is that of :mod:`apex_ompl.problems.constrained_held`. Lengths are in meters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from apex_ompl.problems.broad_parts import shift, turn
from apex_ompl.problems.constrained_held import CARGO_GAP, CARGO_LENGTH, LEVEL, TraySize
from apex_ompl.problems.objects import box, primitive, upright_bar
from apex_ompl.problems.scenes import BOARD
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

TILT = 0.4  # largest roll and pitch of a tray that need not be level [rad]
SHELF_TILT = 0.12  # the same inside a shelf [rad]
YAW = 0.5  # largest yaw [rad]
HAND = 0.13  # that a hand needs beside the end of a tray


@dataclass(frozen=True, eq=False)
class TrayTask:
    """A scene in which a tray goes from one pose to another.

    Attributes:
        scene: Obstacles.
        start: Pose of the tray at the start, shape (4, 4) [m].
        goal: The same at the goal.
    """

    scene: tuple[Obstacle, ...]
    start: Array
    goal: Array


def pose(rng: np.random.Generator, kind: str, point: tuple[float, float, float], yaw: float, tilt: float) -> Array:
    """Return a pose of a tray at a point, level on that kind of level, else with a random tilt, shape (4, 4)."""
    level = kind == LEVEL
    roll, pitch = (0.0, 0.0) if level else rng.uniform(-tilt, tilt, 2)
    return shift(*point) @ turn("z", rng.uniform(-yaw, yaw)) @ turn("y", float(pitch)) @ turn("x", float(roll))


def anywhere(rng: np.random.Generator, kind: str) -> Array:
    """Return a pose of a tray in the workspace of both arms, shape (4, 4)."""
    x, y, z = rng.uniform((0.35, -0.3, 0.12), (0.65, 0.3, 0.6))
    return pose(rng, kind, (x, y, z), YAW, TILT)


def shelf(rng: np.random.Generator, kind: str, size: TraySize) -> TrayTask:
    """Draw a shelf of two or three wide compartments; the tray goes from one into another, or in from before it."""
    loaded = kind == LEVEL
    low, rows = rng.uniform(0.03, 0.2), int(rng.integers(2, 4))
    gap = rng.uniform(0.28, 0.38) if loaded else rng.uniform(0.24, 0.34)
    depth, front = rng.uniform(0.25, 0.45), rng.uniform(0.5, 0.62)
    width = 2.0 * (size.half_length + HAND) + rng.uniform(0.15, 0.45)
    height, x = rows * gap, front + depth / 2
    scene = [box(f"board_{k}", (depth, width, BOARD), (x, 0.0, low + k * gap)) for k in range(rows + 1)]
    for name, y in (("right", -width / 2), ("left", width / 2)):
        scene.append(box(f"upright_{name}", (depth, BOARD, height + BOARD), (x, y, low + height / 2)))
    if rng.random() < 0.7:
        scene.append(box("back", (BOARD, width + BOARD, height + BOARD), (front + depth, 0.0, low + height / 2)))
    side = (width / 2 - size.half_length - HAND) * 0.6
    ends = []
    for row in rng.permutation(rows)[:2]:
        z = low + row * gap + (rng.uniform(0.08, 0.11) if loaded else rng.uniform(0.1, gap - 0.1))
        point = (front + rng.uniform(0.0, 0.6) * depth, rng.uniform(-side, side), z)
        ends.append(pose(rng, kind, point, 0.15, SHELF_TILT))
    if rng.random() < 0.3:  # from before the shelf
        ends[0] = pose(rng, kind, (front - 0.2, rng.uniform(-0.3, 0.3), rng.uniform(0.12, 0.6)), 0.3, TILT)
    return TrayTask(tuple(scene), ends[0], ends[1])


def wall(rng: np.random.Generator, kind: str, size: TraySize) -> TrayTask:
    """Draw a low wall between the arms, some with a beam above it; the tray goes over it from side to side."""
    y, height, thick = rng.uniform(-0.08, 0.08), rng.uniform(0.1, 0.3), rng.uniform(0.02, 0.05)
    near, far = rng.uniform(0.15, 0.3), rng.uniform(0.8, 1.1)
    scene = [box("wall", (far - near, thick, height), ((near + far) / 2, y, height / 2))]
    if rng.random() < 0.6:
        opening = rng.uniform(0.4, 0.5) + (CARGO_LENGTH + CARGO_GAP) * (kind == LEVEL)
        scene.append(box("beam", (far - near, thick, 0.2), ((near + far) / 2, y, height + opening + 0.1)))
    ends = []
    for side in (1.0, -1.0):
        beside = y + side * (size.half_length + HAND + thick / 2 + rng.uniform(0.0, 0.1))
        point = (rng.uniform(0.4, 0.6), beside, rng.uniform(0.12, height + 0.1))
        ends.append(pose(rng, kind, point, 0.2, 0.5 * TILT))
    order = rng.permutation(2)
    return TrayTask(tuple(scene), ends[order[0]], ends[order[1]])


def posts(rng: np.random.Generator, kind: str, size: TraySize) -> TrayTask:
    """Draw standing and hanging posts in the middle; the tray goes from one side of them to the other."""
    scene = []
    for k in range(int(rng.integers(1, 4))):
        length = rng.uniform(0.2, 0.5)
        place = (rng.uniform(0.3, 0.8), rng.uniform(-0.12, 0.12), length / 2)
        scene.append(upright_bar(f"post_{k}", rng.uniform(0.015, 0.05), round(length, 4), place))
    for k in range(int(rng.integers(0, 3))):
        length = rng.uniform(0.2, 0.5)
        place = (rng.uniform(0.3, 0.8), rng.uniform(-0.3, 0.3), 1.1 - length / 2)
        scene.append(upright_bar(f"hanging_{k}", rng.uniform(0.015, 0.05), round(length, 4), place))
    ends = []
    for side in (1.0, -1.0):
        point = (rng.uniform(0.38, 0.6), side * rng.uniform(0.15, 0.38), rng.uniform(0.12, 0.35))
        ends.append(pose(rng, kind, point, 0.3, TILT))
    order = rng.permutation(2)
    return TrayTask(tuple(scene), ends[order[0]], ends[order[1]])


def clutter(rng: np.random.Generator, kind: str, size: TraySize) -> TrayTask:
    """Draw six to twenty-four primitives around the way of the tray from one side to the other."""
    side = float(rng.choice([-1.0, 1.0]))
    points = [(rng.uniform(0.36, 0.62), s * rng.uniform(0.1, 0.36), rng.uniform(0.15, 0.55)) for s in (side, -side)]
    ends = [pose(rng, kind, point, YAW, TILT) for point in points]
    scene = []
    for k in range(int(rng.integers(6, 25))):
        share = rng.uniform(0.0, 1.0)
        middle = (1.0 - share) * ends[0][:3, 3] + share * ends[1][:3, 3]
        center = np.maximum(middle + rng.normal(0.0, (0.2, 0.25, 0.2)), (0.05, -0.9, 0.05))
        size_of = rng.uniform(0.03, (0.12, 0.12, 0.3))
        scene.append(primitive(f"thing_{k}", int(rng.integers(4)), size_of, center, rng.normal(size=4)))
    return TrayTask(tuple(scene), ends[0], ends[1])


SCENES: dict[str, Callable[[np.random.Generator, str, TraySize], TrayTask]] = {
    "shelf": shelf, "wall": wall, "posts": posts, "clutter": clutter,
}  # fmt: skip
"""Suite -> how its scenes are drawn for a tray."""
