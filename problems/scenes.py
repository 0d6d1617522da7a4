"""Scenes in which both arms are busy at once: shelf, bins, cage, posts, wall, swap and clutter.

Each function draws obstacles and the regions of both hands at the start and at the goal. Lengths are in meters. The
arms stand at y = 0.5 (left) and -0.5 (right) on tables whose surface is z = 0, and reach forward along x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from apex_ompl.goals.state_sampling import Direction, HandRegion
from apex_ompl.problems.obstacles import bar, box, primitive
from apex_ompl.scene.bodies import Obstacle

FORWARD: Direction = (1.0, 0.0, 0.0)
DOWN: Direction = (0.0, 0.0, -1.0)
BOARD = 0.02  # thickness of boards and walls [m]
RegionPair = tuple[HandRegion, HandRegion]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class ReachingTask:
    """A scene in which both hands go from one region to another.

    Attributes:
        scene: Obstacles.
        start: Regions of the left and of the right hand at the start.
        goal: Regions of the left and of the right hand at the goal.
    """

    scene: tuple[Obstacle, ...]
    start: RegionPair
    goal: RegionPair


def around(point: Point, half_width: float, *fingers: Direction) -> HandRegion:
    """Return the cubic region around a point, with the directions that the fingers may point along."""
    x, y, z = ((v - half_width, v + half_width) for v in point)
    return HandRegion(x, y, z, fingers)


def shelf(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw a shelf of three columns and three rows; each hand goes from one compartment into another."""
    width, height, depth, reach_in = {
        "easy": (0.5, 0.36, 0.22, 0.05),
        "medium": (0.44, 0.32, 0.3, 0.1),
        "hard": (0.4, 0.29, 0.36, 0.14),
        "extreme": (0.34, 0.248, 0.44, 0.19),
    }[level]  # of a compartment; how far the hands reach into it
    front, low = rng.uniform(0.56, 0.62), rng.uniform(0.08, 0.2)
    columns = width * (np.arange(4) - 1.5) + rng.uniform(-0.04, 0.04)
    rows = low + height * np.arange(4)
    total_height, total_width = 3 * height + BOARD, 3 * width + BOARD
    x, y, z = front + depth / 2, float(columns.mean()), low + 1.5 * height
    scene = [
        *(box(f"upright_{k}", (depth, BOARD, total_height), (x, at, z)) for k, at in enumerate(columns)),
        *(box(f"board_{k}", (depth, total_width, BOARD), (x, y, at)) for k, at in enumerate(rows)),
        box("back", (BOARD, total_width, total_height), (front + depth + BOARD / 2, y, z)),
    ]
    # The left hand uses the columns 1 and 2, the right one 0 and 1; both in column 1 have to be in different rows.
    left, right = rng.permutation([2, 1]), rng.permutation([1, 0])
    while True:
        start_rows, goal_rows = rng.integers(0, 3, 2), rng.integers(0, 3, 2)
        cells = [(left[0], start_rows[0]), (right[0], start_rows[1]), (left[1], goal_rows[0]), (right[1], goal_rows[1])]
        if cells[0] != cells[1] and cells[2] != cells[3]:
            break
    regions = [
        around((front + reach_in, float(columns[c] + width / 2), float(rows[r] + height / 2)), 0.02, FORWARD)
        for c, r in cells
    ]
    return ReachingTask(tuple(scene), (regions[0], regions[1]), (regions[2], regions[3]))


def bins(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw four open bins on the tables; each hand goes from inside one bin to inside another."""
    height, width, reach_in = {
        "easy": (0.16, 0.34, 0.02),
        "medium": (0.3, 0.27, 0.14),
        "hard": (0.34, 0.255, 0.165),
        "extreme": (0.4, 0.245, 0.165),
    }[level]
    scene, regions = [], []
    for k, middle in enumerate((-0.62, -0.22, 0.22, 0.62)):
        x, y = rng.uniform(0.44, 0.54), middle + rng.uniform(-0.03, 0.03)
        for side, (dx, dy) in {"near": (-1, 0), "far": (1, 0), "right": (0, -1), "left": (0, 1)}.items():
            size = (BOARD, width, height) if dx else (width, BOARD, height)
            scene.append(box(f"bin_{k}_{side}", size, (x + dx * width / 2, y + dy * width / 2, height / 2)))
        regions.append(around((x, y, height - reach_in), 0.02, DOWN))
    rack = {"hard": 0.9, "extreme": 0.75}.get(level)  # its height
    if rack is not None:
        scene.append(box("rack", (0.3, 1.6, BOARD), (0.5, 0.0, rack)))
    left, right = rng.permutation([3, 2]), rng.permutation([0, 1])
    return ReachingTask(tuple(scene), (regions[left[0]], regions[right[0]]), (regions[left[1]], regions[right[1]]))


def cage(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw a roofed cage of bars before each arm; each hand goes from inside its cage to outside, or the reverse.

    On ``hard`` both ends of a motion are inside, reached between the bars of different sides.
    """
    spacing, per_side, height = {"easy": (0.44, 2, 0.6), "medium": (0.39, 2, 0.6), "hard": (0.27, 2, 0.6)}[level]
    scene, ends = [], []
    reverse = bool(rng.integers(2))
    for side, middle in (("left", 0.3), ("right", -0.3)):
        x, y = 0.6 + rng.uniform(-0.03, 0.03), middle + rng.uniform(-0.02, 0.02)
        half = spacing * (per_side - 1) / 2
        positions = {(dx, dy) for dx in np.linspace(-half, half, per_side) for dy in (-half, half)}
        positions |= {(dx, dy) for dx in (-half, half) for dy in np.linspace(-half, half, per_side)}
        for k, (dx, dy) in enumerate(sorted(positions)):
            scene.append(bar(f"{side}_bar_{k}", 0.012, height, (x + dx, y + dy, height / 2)))
        scene.append(box(f"{side}_roof", (2 * half + 0.04, 2 * half + 0.04, BOARD), (x, y, height + BOARD / 2)))
        low, high = rng.uniform(0.15, 0.25), rng.uniform(height - 0.25, height - 0.15)
        inside = around((x, y, rng.choice([low, high])), 0.02, FORWARD)
        away = around((0.45, float(np.sign(y)) * (abs(y) + half + 0.22), rng.uniform(0.15, 0.45)), 0.05, FORWARD, DOWN)
        if level == "hard":  # inside too, through another side
            away = around((x, y, low + high - inside.z[0] - 0.02), 0.02, (0.0, -float(np.sign(y)), 0.0))
        ends.append((inside, away))
    (a, b), (c, d) = ends
    return ReachingTask(tuple(scene), (b, d), (a, c)) if reverse else ReachingTask(tuple(scene), (a, c), (b, d))


def posts(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw a fence of posts too tall to reach over, and posts behind it; each hand goes from one gap to another."""
    spacing, behind_count = {"easy": (0.36, 0), "medium": (0.31, 2), "hard": (0.285, 4)}[level]
    count, front = round(1.7 / spacing), rng.uniform(0.42, 0.48)
    fence = (np.arange(count) - (count - 1) / 2) * spacing + rng.uniform(-0.03, 0.03, count)
    positions = [(front + rng.uniform(-0.02, 0.02), y) for y in fence]
    while len(positions) < count + behind_count:
        x, y = rng.uniform([front + 0.2, -0.7], [0.85, 0.7])
        if all(np.hypot(x - u, y - v) > 0.2 for u, v in positions):
            positions.append((x, y))
    scene = [bar(f"post_{k}", rng.uniform(0.015, 0.025), 1.1, (x, y, 0.55)) for k, (x, y) in enumerate(positions)]
    gaps = (fence[:-1] + fence[1:]) / 2
    left, right = rng.permutation(gaps[-(len(gaps) // 2) :])[:2], rng.permutation(gaps[: len(gaps) // 2])[:2]

    def behind(y: float) -> HandRegion:
        return HandRegion((front + 0.12, front + 0.2), (y - 0.02, y + 0.02), (0.15, 0.6), (DOWN, FORWARD))

    ends = [(behind(a), behind(b)) for a, b in zip(left, right, strict=True)]
    return ReachingTask(tuple(scene), ends[0], ends[1])


def wall(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw a wall between the arms with two windows, through which the hands reach to the other side."""
    opening = {"easy": 0.31, "medium": 0.29, "hard": 0.23, "extreme": 0.2015}[level]
    thickness, near, far, height = 0.03, 0.1, 1.0, 1.1
    x, z = rng.uniform(0.48, 0.54), np.sort(rng.uniform([0.2, 0.58], [0.26, 0.64]))
    windows = [(x, float(z[0])), (x, float(z[1]))]
    scene = [
        box("near", (x - opening / 2 - near, thickness, height), ((x - opening / 2 + near) / 2, 0.0, height / 2)),
        box("far", (far - x - opening / 2, thickness, height), ((far + x + opening / 2) / 2, 0.0, height / 2)),
    ]
    levels = [0.0, z[0] - opening / 2, z[0] + opening / 2, z[1] - opening / 2, z[1] + opening / 2, height]
    for k in range(3):
        low, high = levels[2 * k], levels[2 * k + 1]
        scene.append(box(f"beam_{k}", (opening, thickness, high - low), (x, 0.0, (low + high) / 2)))
    reach_through = {"easy": 0.06, "medium": 0.1, "hard": 0.12, "extreme": 0.14}[level]

    def through(side: float, window: int) -> HandRegion:
        wx, wz = windows[window]
        return around((wx, -side * reach_through, wz), 0.02, (0.0, -side, 0.0))

    def beside(side: float) -> HandRegion:
        y = sorted((side * 0.3, side * 0.6))
        return HandRegion((0.4, 0.65), (y[0], y[1]), (0.15, 0.6), (DOWN, FORWARD))

    first = int(rng.integers(2))
    start, goal = [through(1, first), through(-1, 1 - first)], [through(1, 1 - first), through(-1, first)]
    if level == "easy":  # one hand changes windows, the other one stays on its side
        other = int(rng.integers(2))
        start[other] = goal[other] = beside((1, -1)[other])
    return ReachingTask(tuple(scene), (start[0], start[1]), (goal[0], goal[1]))


def swap(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw two pigeonholes before the arms, one higher than the other; the hands exchange their pigeonholes."""
    size, depth = {"easy": (0.4, 0.1), "medium": (0.315, 0.19), "hard": (0.28, 0.22), "extreme": (0.248, 0.32)}[level]
    front = rng.uniform(0.55, 0.6)
    side, low = float(rng.choice([-1.0, 1.0])), rng.uniform(0.16, 0.22) + size / 2 - 0.15
    regions, scene = [], []
    for name, y, z in (("low", side * 0.18, low), ("high", -side * 0.18, low + size + 0.06)):
        x = front + depth / 2
        scene += [
            box(f"{name}_floor", (depth, size + BOARD, BOARD), (x, y, z - size / 2)),
            box(f"{name}_roof", (depth, size + BOARD, BOARD), (x, y, z + size / 2)),
            box(f"{name}_left", (depth, BOARD, size), (x, y + size / 2, z)),
            box(f"{name}_right", (depth, BOARD, size), (x, y - size / 2, z)),
            box(f"{name}_back", (BOARD, size + BOARD, size + BOARD), (front + depth + BOARD / 2, y, z)),
        ]
        regions.append(around((front + 0.3 * depth, y, z), 0.02, FORWARD))
    left, right = regions if side > 0 else regions[::-1]
    ends = [(left, right), (right, left)]
    order = rng.permutation(2)
    return ReachingTask(tuple(scene), ends[order[0]], ends[order[1]])


def clutter(rng: np.random.Generator, level: str) -> ReachingTask:
    """Draw ten to forty-five primitives, 4 cm to half a meter long; each hand moves sideways among them."""
    count, widest, longest = {
        "easy": (10, 0.14, 0.2),
        "medium": (20, 0.14, 0.3),
        "hard": (30, 0.14, 0.4),
        "extreme": (45, 0.11, 0.5),
    }[level]
    scene = []
    for k in range(count):
        quaternion = rng.normal(size=4)
        position = rng.uniform([0.05, -0.8, 0.1], [0.8, 0.8, 1.0])
        size, kind = rng.uniform(0.04, (widest, widest, longest)), int(rng.integers(4))
        # Frozen problems hold these names.
        scene.append(primitive(f"thing_{k}", kind, size, position, quaternion))

    def side(y: float) -> HandRegion:
        return HandRegion((0.4, 0.75), (y - 0.15, y + 0.15), (0.12, 0.7), (DOWN, FORWARD))

    ends = [(side(0.65), side(-0.1)), (side(0.1), side(-0.65))]
    order = rng.permutation(2)
    return ReachingTask(tuple(scene), ends[order[0]], ends[order[1]])


SUITES: dict[str, Callable[[np.random.Generator, str], ReachingTask]] = {
    "shelf": shelf, "bins": bins, "cage": cage, "posts": posts, "wall": wall, "swap": swap, "clutter": clutter,
}  # fmt: skip
LEVELS = {
    suite: ("easy", "medium", "hard") if suite in ("cage", "posts") else ("easy", "medium", "hard", "extreme")
    for suite in SUITES
}
"""Suite -> its levels; rrtconnect with a tuned range takes long enough on ``hard`` of ``cage`` and ``posts``."""
