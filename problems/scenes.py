"""Scenes in which both arms are busy at once: shelf, bins, cage, posts, wall, swap and clutter.

Each returns obstacles and the regions of both hands at the start and at the goal. Lengths are in metres; the arms
stand at y = 0.5 (left) and -0.5 (right) on tables whose surface is z = 0, and reach forward along x.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apex_ompl.problems.reach import Direction, Region
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

FORWARD: Direction = (1.0, 0.0, 0.0)
DOWN: Direction = (0.0, 0.0, -1.0)
BOARD = 0.02
Pair = tuple[Region, Region]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Draft:
    """A scene with the regions of the left and of the right hand at start and goal."""

    scene: tuple[Obstacle, ...]
    start: Pair
    goal: Pair


def box(name: str, size: Sequence[float], position: Sequence[float]) -> Obstacle:
    """Return an upright box, its numbers rounded to a tenth of a millimetre."""
    return _made(name=name, box=_short(size), position=_short(position))


def bar(name: str, radius: float, length: float, position: Sequence[float]) -> Obstacle:
    """Return an upright cylinder, its numbers rounded to a tenth of a millimetre."""
    return _made(name=name, cylinder={"radius": _short([radius])[0], "length": length}, position=_short(position))


def _made(**fields: Any) -> Obstacle:
    return Obstacle.model_validate(fields)


def _short(numbers: Iterable[float]) -> tuple[float, ...]:
    return tuple(round(float(v), 4) for v in numbers)


def primitive(name: str, kind: int, size: Array, position: Array, turn: Array) -> Obstacle:
    """Return a box, a ball, a cylinder or a capsule (kind 0 to 3) of a size, turned by a quaternion of any length."""
    wide, _, long = _short(size)
    shapes: tuple[dict[str, Any], ...] = (
        {"box": _short(size)}, {"sphere": {"radius": wide / 2}},
        {"cylinder": {"radius": wide / 2, "length": long}}, {"capsule": {"radius": wide / 2, "length": long}},
    )  # fmt: skip
    unit = np.round(turn / np.linalg.norm(turn), 6)
    return _made(name=name, **shapes[kind], position=_short(position), orientation=tuple(float(v) for v in unit))


def around(point: Point, slack: float, *fingers: Direction) -> Region:
    """Return the region around a point."""
    x, y, z = ((v - slack, v + slack) for v in point)
    return Region(x, y, z, fingers)


def shelf(rng: np.random.Generator, level: str) -> Draft:
    """A shelf of three columns and three rows; each hand goes from one compartment into another."""
    wide, high, depth, inside = {
        "easy": (0.5, 0.36, 0.22, 0.05),
        "medium": (0.44, 0.32, 0.3, 0.1),
        "hard": (0.4, 0.29, 0.36, 0.14),
    }[level]  # of a compartment, and how far the hands are in it
    front, low = rng.uniform(0.56, 0.62), rng.uniform(0.08, 0.2)
    columns = wide * (np.arange(4) - 1.5) + rng.uniform(-0.04, 0.04)
    rows = low + high * np.arange(4)
    tall, broad = 3 * high + BOARD, 3 * wide + BOARD
    x, y, z = front + depth / 2, float(columns.mean()), low + 1.5 * high
    scene = [
        *(box(f"upright_{k}", (depth, BOARD, tall), (x, at, z)) for k, at in enumerate(columns)),
        *(box(f"board_{k}", (depth, broad, BOARD), (x, y, at)) for k, at in enumerate(rows)),
        box("back", (BOARD, broad, tall), (front + depth + BOARD / 2, y, z)),
    ]
    # The left hand goes between the columns 1 and 2, the right one between 0 and 1: in column 1 they may meet.
    left, right = rng.permutation([2, 1]), rng.permutation([1, 0])
    while True:
        start_rows, goal_rows = rng.integers(0, 3, 2), rng.integers(0, 3, 2)
        cells = [(left[0], start_rows[0]), (right[0], start_rows[1]), (left[1], goal_rows[0]), (right[1], goal_rows[1])]
        if cells[0] != cells[1] and cells[2] != cells[3]:
            break
    spots = [
        around((front + inside, float(columns[c] + wide / 2), float(rows[r] + high / 2)), 0.02, FORWARD)
        for c, r in cells
    ]
    return Draft(tuple(scene), (spots[0], spots[1]), (spots[2], spots[3]))


def bins(rng: np.random.Generator, level: str) -> Draft:
    """Four open bins on the tables; each hand goes from the depth of one to the depth of another."""
    high, wide, deep = {"easy": (0.16, 0.34, 0.02), "medium": (0.3, 0.27, 0.14), "hard": (0.34, 0.255, 0.165)}[level]
    scene, spots = [], []
    for k, middle in enumerate((-0.62, -0.22, 0.22, 0.62)):
        x, y = rng.uniform(0.44, 0.54), middle + rng.uniform(-0.03, 0.03)
        for side, (dx, dy) in {"near": (-1, 0), "far": (1, 0), "right": (0, -1), "left": (0, 1)}.items():
            size = (BOARD, wide, high) if dx else (wide, BOARD, high)
            scene.append(box(f"bin_{k}_{side}", size, (x + dx * wide / 2, y + dy * wide / 2, high / 2)))
        spots.append(around((x, y, high - deep), 0.02, DOWN))
    if level == "hard":
        scene.append(box("rack", (0.3, 1.6, BOARD), (0.5, 0.0, 0.9)))
    left, right = rng.permutation([3, 2]), rng.permutation([0, 1])
    return Draft(tuple(scene), (spots[left[0]], spots[right[0]]), (spots[left[1]], spots[right[1]]))


def cage(rng: np.random.Generator, level: str) -> Draft:
    """A roofed cage of bars in front of each arm; the hands reach in between the bars, from one side to another."""
    gap, bars, tall = {"easy": (0.44, 2, 0.6), "medium": (0.39, 2, 0.6), "hard": (0.27, 2, 0.6)}[level]
    scene, ends = [], []
    flip = bool(rng.integers(2))
    for side, middle in (("left", 0.3), ("right", -0.3)):
        x, y = 0.6 + rng.uniform(-0.03, 0.03), middle + rng.uniform(-0.02, 0.02)
        half = gap * (bars - 1) / 2
        spots = {(dx, dy) for dx in np.linspace(-half, half, bars) for dy in (-half, half)}
        spots |= {(dx, dy) for dx in (-half, half) for dy in np.linspace(-half, half, bars)}
        for k, (dx, dy) in enumerate(sorted(spots)):
            scene.append(bar(f"{side}_bar_{k}", 0.012, tall, (x + dx, y + dy, tall / 2)))
        scene.append(box(f"{side}_roof", (2 * half + 0.04, 2 * half + 0.04, BOARD), (x, y, tall + BOARD / 2)))
        low, high = rng.uniform(0.15, 0.25), rng.uniform(tall - 0.25, tall - 0.15)
        inside = around((x, y, rng.choice([low, high])), 0.02, FORWARD)
        away = around((0.45, float(np.sign(y)) * (abs(y) + half + 0.22), rng.uniform(0.15, 0.45)), 0.05, FORWARD, DOWN)
        if level == "hard":  # into the cage by another side
            away = around((x, y, low + high - inside.z[0] - 0.02), 0.02, (0.0, -float(np.sign(y)), 0.0))
        ends.append((inside, away))
    (a, b), (c, d) = ends
    return Draft(tuple(scene), (b, d), (a, c)) if flip else Draft(tuple(scene), (a, c), (b, d))


def posts(rng: np.random.Generator, level: str) -> Draft:
    """A fence of posts too tall to pass over, and some behind it; the hands go from one gap to another."""
    gap, more = {"easy": (0.36, 0), "medium": (0.31, 2), "hard": (0.285, 4)}[level]
    count, front = round(1.7 / gap), rng.uniform(0.42, 0.48)
    rows = (np.arange(count) - (count - 1) / 2) * gap + rng.uniform(-0.03, 0.03, count)
    spots = [(front + rng.uniform(-0.02, 0.02), y) for y in rows]
    while len(spots) < count + more:
        x, y = rng.uniform([front + 0.2, -0.7], [0.85, 0.7])
        if all(np.hypot(x - u, y - v) > 0.2 for u, v in spots):
            spots.append((x, y))
    scene = [bar(f"post_{k}", rng.uniform(0.015, 0.025), 1.1, (x, y, 0.55)) for k, (x, y) in enumerate(spots)]
    gaps = (rows[:-1] + rows[1:]) / 2
    left, right = rng.permutation(gaps[-(len(gaps) // 2) :])[:2], rng.permutation(gaps[: len(gaps) // 2])[:2]

    def behind(y: float) -> Region:
        return Region((front + 0.12, front + 0.2), (y - 0.02, y + 0.02), (0.15, 0.6), (DOWN, FORWARD))

    ends = [(behind(a), behind(b)) for a, b in zip(left, right, strict=True)]
    return Draft(tuple(scene), ends[0], ends[1])


def wall(rng: np.random.Generator, level: str) -> Draft:
    """A wall between the arms with two windows, through which hands reach over to the other side."""
    size = {"easy": 0.31, "medium": 0.29, "hard": 0.23}[level]
    thick, near, far, tall = 0.03, 0.1, 1.0, 1.1
    x, z = rng.uniform(0.48, 0.54), np.sort(rng.uniform([0.2, 0.58], [0.26, 0.64]))
    windows = [(x, float(z[0])), (x, float(z[1]))]
    scene = [
        box("near", (x - size / 2 - near, thick, tall), ((x - size / 2 + near) / 2, 0.0, tall / 2)),
        box("far", (far - x - size / 2, thick, tall), ((far + x + size / 2) / 2, 0.0, tall / 2)),
    ]
    levels = [0.0, z[0] - size / 2, z[0] + size / 2, z[1] - size / 2, z[1] + size / 2, tall]
    for k in range(3):
        low, high = levels[2 * k], levels[2 * k + 1]
        scene.append(box(f"beam_{k}", (size, thick, high - low), (x, 0.0, (low + high) / 2)))
    deep = {"easy": 0.06, "medium": 0.1, "hard": 0.12}[level]

    def through(side: float, window: int) -> Region:
        wx, wz = windows[window]
        return around((wx, -side * deep, wz), 0.02, (0.0, -side, 0.0))

    def beside(side: float) -> Region:
        y = sorted((side * 0.3, side * 0.6))
        return Region((0.4, 0.65), (y[0], y[1]), (0.15, 0.6), (DOWN, FORWARD))

    first = int(rng.integers(2))
    start, goal = [through(1, first), through(-1, 1 - first)], [through(1, 1 - first), through(-1, first)]
    if level == "easy":  # one hand changes windows, the other one stays on its side
        other = int(rng.integers(2))
        start[other] = goal[other] = beside((1, -1)[other])
    return Draft(tuple(scene), (start[0], start[1]), (goal[0], goal[1]))


def swap(rng: np.random.Generator, level: str) -> Draft:
    """Two holes in front of the arms, one above the other: each hand goes from the one near it into the other one."""
    size, depth = {"easy": (0.4, 0.1), "medium": (0.315, 0.19), "hard": (0.28, 0.22)}[level]
    front = rng.uniform(0.55, 0.6)
    side, low = float(rng.choice([-1.0, 1.0])), rng.uniform(0.16, 0.22) + size / 2 - 0.15
    spots, scene = [], []
    for name, y, z in (("low", side * 0.18, low), ("high", -side * 0.18, low + size + 0.06)):
        x = front + depth / 2
        scene += [
            box(f"{name}_floor", (depth, size + BOARD, BOARD), (x, y, z - size / 2)),
            box(f"{name}_roof", (depth, size + BOARD, BOARD), (x, y, z + size / 2)),
            box(f"{name}_left", (depth, BOARD, size), (x, y + size / 2, z)),
            box(f"{name}_right", (depth, BOARD, size), (x, y - size / 2, z)),
            box(f"{name}_back", (BOARD, size + BOARD, size + BOARD), (front + depth + BOARD / 2, y, z)),
        ]
        spots.append(around((front + 0.3 * depth, y, z), 0.02, FORWARD))
    left, right = spots if side > 0 else spots[::-1]
    ends = [(left, right), (right, left)]
    order = rng.permutation(2)
    return Draft(tuple(scene), ends[order[0]], ends[order[1]])


def clutter(rng: np.random.Generator, level: str) -> Draft:
    """Ten to thirty boxes, balls, cylinders and capsules, 4 cm to half a metre long; the hands go across."""
    count, longest, scene = *{"easy": (10, 0.2), "medium": (20, 0.3), "hard": (30, 0.4)}[level], []
    for k in range(count):
        turn = rng.normal(size=4)
        place = rng.uniform([0.05, -0.8, 0.1], [0.8, 0.8, 1.0])
        size, kind = rng.uniform(0.04, (0.14, 0.14, longest)), int(rng.integers(4))
        scene.append(primitive(f"thing_{k}", kind, size, place, turn))

    def side(y: float) -> Region:
        return Region((0.4, 0.75), (y - 0.15, y + 0.15), (0.12, 0.7), (DOWN, FORWARD))

    ends = [(side(0.65), side(-0.1)), (side(0.1), side(-0.65))]
    order = rng.permutation(2)
    return Draft(tuple(scene), ends[order[0]], ends[order[1]])


SUITES: dict[str, Callable[[np.random.Generator, str], Draft]] = {
    "shelf": shelf, "bins": bins, "cage": cage, "posts": posts, "wall": wall, "swap": swap, "clutter": clutter,
}  # fmt: skip
LEVELS = ("easy", "medium", "hard")
