"""The suites ``vertical`` (stacking) and ``horizontal`` (insertion): the paper's tasks with objects in both hands.

Starts are home + N(0, 0.35^2), the objects at least 8 cm above the tables and 0.4 m apart. Goals are found by inverse
kinematics from home + N(0, 0.6^2). Both are free by 1 cm, except that the two objects are in contact at the goal.

Obstacles are cubes. Their centers are those of a held object at a random state in the middle half of the straight line
from start to goal, + N(0, 0.1^2) m; cubes drawn evenly over the workspace would rarely block a motion. A static cube
keeps 3 cm to start and goal. On ``extreme`` 100 and 70 cubes, which may overlap, form a cave: they are spread by
N(0, 0.2^2) m and keep 1.5 cm. A moving cube keeps 3 cm to the start at time 0, and to the goal at the time when the
straight line ends there; at earlier times it may overlap the goal.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from apex_ompl.goals.grasp import HandObjects
from apex_ompl.goals.state_sampling import AlignmentSampler, scene_kernel
from apex_ompl.problems.drawn_problem import MARGIN, DrawnProblem
from apex_ompl.problems.objects import block_and_peg, boxes, cup_and_ball
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Alignment
from apex_ompl.types import Array

SIZES = {"small": 0.06, "medium": 0.10, "large": 0.15, "xlarge": 0.20, "huge": 0.30}  # edges of the cubes [m]
STATIC = ("small", "medium", "large", "xlarge", "huge", "extreme")
SPEEDS = (0.1, 0.2, 0.4)  # [m/s]
MAX_CUBES = 3
EXTREME_CUBES = {"vertical": 100, "horizontal": 70}
START_SPREAD = 0.35  # standard deviation of starts around home [rad]
START_HEIGHT, START_SEPARATION = 0.08, 0.4  # of the objects above the tables, and of their centers [m]
CUBE_MARGIN, EXTREME_MARGIN = 0.03, 0.015  # of cubes to start and goal [m]
CUBE_SPREAD, EXTREME_SPREAD = 0.1, 0.2  # standard deviation of the centers of cubes around those of held objects [m]
CUBE_ATTEMPTS = 20  # positions tried for a cube
VELOCITY_SCALE = 0.25  # of the velocity limits, at which straight lines are followed


def _stacking(thick: float, tall: float) -> AlignmentSampler:
    alignment = Alignment(kind="vertical", first="lower", second="upper")
    return AlignmentSampler(robot(), boxes(thick, tall), alignment, MARGIN)


def _insertion(objects: Callable[[], HandObjects], first: str, second: str) -> AlignmentSampler:
    alignment = Alignment(kind="horizontal", first=first, second=second)
    return AlignmentSampler(robot(), objects(), alignment, MARGIN)


SAMPLERS: dict[str, tuple[Callable[[], AlignmentSampler], ...]] = {
    "vertical": tuple(
        cache(partial(_stacking, thick, tall)) for thick, tall in ((0.06, 0.12), (0.07, 0.14), (0.06, 0.16))
    ),
    "horizontal": (
        cache(partial(_insertion, cup_and_ball, "cup", "ball")),
        cache(partial(_insertion, block_and_peg, "block", "peg")),
    ),
}
"""Suite -> samplers of its pairs of objects, each made at its first call."""


def draw(rng: np.random.Generator, suite: str, level: str) -> DrawnProblem | None:
    """Draw a problem of a suite and level; None when this draw has no start, no goal or no position of a cube."""
    sampler = SAMPLERS[suite][int(rng.integers(len(SAMPLERS[suite])))]()
    start = sampler.sample_start(rng, START_SPREAD, START_HEIGHT, START_SEPARATION)
    goal = sampler.sample_goal(rng)
    if start is None or goal is None:
        return None
    size, speed = cube_size_and_speed(level)
    extreme = level == "extreme"
    count = EXTREME_CUBES[suite] if extreme else int(rng.integers(1, MAX_CUBES + 1)) if speed == 0.0 else 1
    margin, spread = (EXTREME_MARGIN, EXTREME_SPREAD) if extreme else (CUBE_MARGIN, CUBE_SPREAD)
    cubes: list[Obstacle] = []
    for k in range(count if size > 0.0 else 0):
        cube = _draw_cube(rng, sampler, np.stack([start, goal]), size, speed, margin=margin, spread=spread)
        if cube is None:
            return None
        cubes.append(cube.model_copy(update={"name": f"cube_{k}"}))
    return DrawnProblem(tuple(cubes), start, goal, sampler.attached)


def cube_size_and_speed(level: str) -> tuple[float, float]:
    """Return the edge [m] and the speed [m/s] of a level's cubes; size 0 without cubes, speed 0 for static ones."""
    if level == "free":
        return 0.0, 0.0
    if level == "extreme":
        return SIZES["xlarge"], 0.0
    moving, _, rest = level.partition("-")
    if moving != "moving":
        return SIZES[level], 0.0
    size, _, speed = rest.partition("-")
    return SIZES[size], float(speed)


def straight_line_duration(start: Array, goal: Array) -> float:
    """Return how long a straight line takes at ``VELOCITY_SCALE`` of the velocity limits [s]."""
    return float(np.max(np.abs(goal - start) / robot().limits.velocity)) / VELOCITY_SCALE


def _draw_cube(
    rng: np.random.Generator,
    sampler: AlignmentSampler,
    ends: Array,
    size: float,
    speed: float,
    *,
    margin: float,
    spread: float,
) -> Obstacle | None:
    """Return a cube near the straight line of a held object, or None when no position was found.

    Args:
        rng: Source of positions and directions.
        sampler: The held objects.
        ends: Start and goal, shape (2, dof).
        size: Edge of the cube [m].
        speed: Of the cube, in a random horizontal direction [m/s].
        margin: Distance that it keeps to start and goal [m].
        spread: Standard deviation of its center around that of the held object [m].
    """
    duration = straight_line_duration(ends[0], ends[1])
    for _ in range(CUBE_ATTEMPTS):
        fraction, held = rng.uniform(0.25, 0.75), int(rng.integers(len(sampler.attached)))
        state = ends[0] + fraction * (ends[1] - ends[0])
        center = sampler.box_corners(state[None])[0, held].mean(axis=0) + rng.normal(0.0, spread, 3)
        heading = rng.uniform(0.0, 2.0 * np.pi)
        velocity = np.round(speed * np.array([np.cos(heading), np.sin(heading), 0.0]), 4)
        center[2] = max(center[2], size / 2)  # above the table
        initial = np.round(center - velocity * fraction * duration, 4)
        final = initial + velocity * duration
        if all(
            _cube_distance(sampler, q, _cube(size, position)) >= margin
            for q, position in zip(ends, (initial, final), strict=True)
        ):
            cube = _cube(size, initial)
            return cube if speed == 0.0 else cube.model_copy(update={"velocity": tuple(velocity.tolist())})
    return None


def _cube(size: float, center: Array) -> Obstacle:
    x, y, z = (float(v) for v in center)
    return Obstacle(name="cube", box=(size, size, size), position=(x, y, z))


def _cube_distance(sampler: AlignmentSampler, q: Array, cube: Obstacle) -> float:
    """Return the distance of the robot with its objects to a cube and to fixtures, ``CUBE_MARGIN`` at most [m]."""
    kernel = scene_kernel(robot(), sampler.tables, [cube])
    return float(kernel.clearance(q, CUBE_MARGIN)[0, 0])
