"""The paper's tasks: objects in both hands are brought together, vertically (stacking) or horizontally (insertion).

Starts are home + N(0, 0.35^2), with the objects 8 cm above the tables and 0.4 m apart; goals come of descents from
home + N(0, 0.6^2). Both are free by 1 cm, except that at the goal the two objects are where the task wants them. A
moving cube is 3 cm off the start at time 0, and off the goal when the straight line gets there; before that it may
be in the place of the goal. Obstacles are cubes, centred where a held object passes on the straight line, in its
middle half, + N(0, 0.1^2) m: spread evenly over the workspace they would hardly ever be in the way.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.kernel import IKSolver, Kernel, RobotTables
from apex_ompl.problems.objects import Held, block_and_peg, boxes, cup_and_ball, put_in_hands
from apex_ompl.problems.outline import Outline
from apex_ompl.problems.reach import keeps_clear, robot, scene_kernel
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Alignment
from apex_ompl.tasks.alignment import RESTART_SPREAD, AlignmentGoal
from apex_ompl.tasks.inverse_kinematics import Links
from apex_ompl.types import Array

SIZES = {"small": 0.06, "medium": 0.10, "large": 0.15, "xlarge": 0.20, "huge": 0.30}  # edges of the cubes [m]
STATIC = ("small", "medium", "large")
MOST_CUBES = 3
SPEEDS = (0.1, 0.2, 0.4)  # [m/s]
START_SPREAD = 0.35  # [rad]
ABOVE_TABLE, APART, CUBE_MARGIN, ASIDE = 0.08, 0.4, 0.03, 0.1  # [m]
PACE = 0.25  # of the velocity limits, at which straight lines are followed
BATCH = 32  # states drawn at once
TRIES = 20  # places tried for a cube


@dataclass(frozen=True, eq=False)
class Holding:
    """Objects in both hands, and how they are to meet.

    Attributes:
        attached: The objects.
        home: The home state with the synergies that hold them, shape (dof,).
        goal: The alignment.
        inverse: Its inverse kinematics, for the arms.
        tables: The robot with the objects; they are not judged against each other, as they end up close together.
        checker: Judges the robot with the objects among its tables, the objects against each other too.
        corners: Corners of a box around each object in the frame of a joint: its number, and shape (8, 3) [m].
    """

    attached: tuple[AttachedObject, ...]
    home: Array
    goal: AlignmentGoal
    inverse: IKSolver
    tables: RobotTables
    checker: CollisionChecker
    corners: tuple[tuple[int, Array], ...]

    @classmethod
    def of(cls, held: Held, alignment: Alignment) -> Holding:
        """Close the hands of the robot on objects."""
        some = robot()
        attached, home, _ = put_in_hands(some, held)
        checker, links = CollisionChecker(some, (), attached), Links.of(some)
        goal = AlignmentGoal(some, alignment, attached, home)
        corners = []
        for body in attached:
            shape = coal_geometry(body)
            shape.computeLocalAABB()
            low, high = shape.aabb_local.min_, shape.aabb_local.max_
            local = np.array(list(itertools.product(*zip(low, high, strict=True))))
            fixed = [links.point(body.link, body.pose[:3, :3] @ corner + body.pose[:3, 3]) for corner in local]
            corners.append((fixed[0].joint, np.array([f.vector for f in fixed])))
        names = [body.name for body in attached]
        tables = checker.kernel.robot.without_pair(names[0], names[1])
        inverse = links.inverse(goal.targets(), some.groups["hands"])
        return cls(attached, home, goal, inverse, tables, checker, tuple(corners))

    def placed(self, kernel: Kernel, states: Array) -> Array:
        """Return the corners of the boxes around the objects at states (N, dof); shape (N, objects, 8, 3) [m]."""
        turn, origin = kernel.joint_frames(states)
        boxes_of = [local @ np.swapaxes(turn[:, j], 1, 2) + origin[:, j, None] for j, local in self.corners]
        return np.stack(boxes_of, axis=1)


def _stack() -> Alignment:
    return Alignment(kind="vertical", first="lower", second="upper")


HOLDINGS: dict[str, tuple[Callable[[], Holding], ...]] = {
    "vertical": tuple(
        cache(lambda thick=thick, tall=tall: Holding.of(boxes(thick, tall), _stack()))
        for thick, tall in ((0.06, 0.12), (0.07, 0.14), (0.06, 0.16))
    ),
    "horizontal": (
        cache(lambda: Holding.of(cup_and_ball(), Alignment(kind="horizontal", first="cup", second="ball"))),
        cache(lambda: Holding.of(block_and_peg(), Alignment(kind="horizontal", first="block", second="peg"))),
    ),
}


def draw(rng: np.random.Generator, suite: str, level: str) -> Outline | None:
    """Draw a problem of a suite and level, or None when this draw does not work out."""
    holding = HOLDINGS[suite][int(rng.integers(len(HOLDINGS[suite])))]()
    kernel = scene_kernel(holding.tables, ())
    start, goal = _start(rng, holding, kernel), _goal(rng, holding, kernel)
    if start is None or goal is None:
        return None
    size, speed = level_of(level)
    cubes: list[Obstacle] = []
    for k in range(int(rng.integers(1, MOST_CUBES + 1)) if speed == 0.0 else 1):
        cube = _cube(rng, holding, np.stack([start, goal]), (size, speed), k) if size > 0.0 else None
        if cube is None and size > 0.0:
            return None
        cubes += [cube] if cube is not None else []
    return Outline(tuple(cubes), start, goal, holding.attached)


def level_of(level: str) -> tuple[float, float]:
    """Return the size [m] and the speed [m/s] of a level's cubes; 0 where there are none, or they stand still."""
    if level == "free":
        return 0.0, 0.0
    moving, _, rest = level.partition("-")
    if moving != "moving":
        return SIZES[level], 0.0
    size, _, speed = rest.partition("-")
    return SIZES[size], float(speed)


def duration(start: Array, goal: Array) -> float:
    """Return how long a straight line takes at ``PACE`` [s]."""
    return float(np.max(np.abs(goal - start) / robot().limits.velocity)) / PACE


def _inside(states: Array) -> NDArray[np.bool_]:
    limits = robot().limits
    return np.asarray(((states >= limits.lower) & (states <= limits.upper)).all(axis=1), bool)


def _start(rng: np.random.Generator, holding: Holding, kernel: Kernel) -> Array | None:
    some = robot()
    states = np.round(holding.home + rng.normal(0.0, START_SPREAD, (BATCH, some.dof)), 6)
    states[:, some.groups["hands"]] = holding.home[some.groups["hands"]]
    boxes_of = holding.placed(kernel, states)
    centres = boxes_of.mean(axis=2)
    apart = np.linalg.norm(centres[:, 0] - centres[:, 1], axis=1)
    good = _inside(states) & (boxes_of[..., 2].min(axis=(1, 2)) >= ABOVE_TABLE) & (apart >= APART)
    return next((q for q in states[good] if keeps_clear(kernel, q)[0] and holding.checker.is_free(q)), None)


def _goal(rng: np.random.Generator, holding: Holding, kernel: Kernel) -> Array | None:
    some = robot()
    states = holding.home + rng.normal(0.0, RESTART_SPREAD, (BATCH, some.dof))
    states[:, some.groups["hands"]] = holding.home[some.groups["hands"]]
    states = np.clip(states, some.limits.lower, some.limits.upper)
    ends = holding.inverse.descend(states, max_steps=40)
    found = np.round(ends.states[ends.errors < 1e-3], 6)
    found = found[_inside(found)]
    good = (q for q in found[keeps_clear(kernel, found)] if holding.goal.is_satisfied(q))
    return next((q for q in good if holding.checker.is_free(q)), None)


def _cube(
    rng: np.random.Generator, holding: Holding, ends: Array, motion: tuple[float, float], number: int
) -> Obstacle | None:
    """Return a cube of a size [m] and speed [m/s] where a held object passes, or None when no place was found."""
    (size, speed), lasts = motion, duration(ends[0], ends[1])
    bare = scene_kernel(holding.tables, ())
    for _ in range(TRIES):
        share, which = rng.uniform(0.25, 0.75), int(rng.integers(len(holding.attached)))
        middle = ends[0] + share * (ends[1] - ends[0])
        centre = holding.placed(bare, middle[None])[0, which].mean(axis=0) + rng.normal(0.0, ASIDE, 3)
        turn = rng.uniform(0.0, 2.0 * np.pi)
        velocity = np.round(speed * np.array([np.cos(turn), np.sin(turn), 0.0]), 4)
        centre[2] = max(centre[2], size / 2)  # not in the table
        begin = np.round(centre - velocity * share * lasts, 4)
        places = (begin, begin + velocity * lasts)
        if all(
            scene_kernel(holding.tables, [_cube_at(size, place)]).clearance(q, CUBE_MARGIN)[0, 0] >= CUBE_MARGIN
            for q, place in zip(ends, places, strict=True)
        ):
            cube = _cube_at(size, begin, f"cube_{number}")
            moving = {"velocity": tuple(velocity.tolist())} if speed > 0.0 else {}
            return cube.model_copy(update=moving)
    return None


def _cube_at(size: float, centre: Array, name: str = "cube") -> Obstacle:
    x, y, z = (float(v) for v in centre)
    return Obstacle(name=name, box=(size, size, size), position=(x, y, z))
