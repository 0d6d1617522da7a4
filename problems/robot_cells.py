"""Cells: a robot, its arms, and the frame in which scenes are drawn for it.

Scenes are drawn in the frame of the two Pandas' cell: their bases are at y = 0.5 m and y = -0.5 m, their front is x,
and what stands stands on z = 0. For another robot a similarity transform moves and scales them: by the reach of its
arms, so that they are before the arms' bases in the direction of their tips at home, or of x where these disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from apex_ompl.collision.shapes import world_geometry
from apex_ompl.collision.tables import primitives
from apex_ompl.goals.arms import Arm, arms_of
from apex_ompl.goals.state_sampling import ArmTables, Direction, HandRegion, Region
from apex_ompl.kernel.scene_builder import Solids
from apex_ompl.problems.broad_parts import Parts, place, scale, turn
from apex_ompl.problems.broad_representation import obstacles, part_of
from apex_ompl.problems.scenes import DOWN, FORWARD
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.types import Array
from apex_ompl.util.cache import weakly_cached

FINGERS = (DOWN, FORWARD, (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0))
SHOULDERS = (0.5, -0.5)  # y of the arms of the Pandas' cell [m]
SENT = 0.78  # largest distance from its shoulder of a place that such an arm is sent to [m]
REACH = 1.015  # of an arm of the Pandas' cell, by its tip [m]
BASE = 0.333  # height of the first joints there [m]
HANGING = 1.0  # the same of arms that hang [m]
AHEAD = 0.5  # distance of the middle of a tip's wide region from the base of the arm [m]
INWARD = 0.3  # share of the way to the middle of all such regions by which each is moved
SHOULDER = 0.35  # height of the middle of what an arm reaches [m]
AGREED = 0.7  # cosine of the angle between directions that agree
LEVEL = 0.1  # of the reach, below which a horizontal distance gives no direction


@dataclass(frozen=True, eq=False)
class Cell:
    """A robot and the frame in which its scenes are drawn.

    Attributes:
        robot: The robot.
        arms: Its arms.
        pose: Pose of the frame in the world, shape (4, 4) [m]; None for that of the world.
        size: Length of a unit of the frame [m].
        shoulders: Middle of what each arm reaches, in the frame, shape (3,).
        middles: Middle x, y of the wide region of each tip, in the frame.
        reaches: Distance from its shoulder of a place that each arm is sent to, in the frame.
    """

    robot: Robot
    arms: tuple[Arm, ...]
    pose: Array | None
    size: float
    shoulders: tuple[Array, ...]
    middles: tuple[tuple[float, float], ...]
    reaches: tuple[float, ...]

    @classmethod
    def of(cls, robot: Robot) -> Cell:
        """Return the cell of a robot.

        Raises:
            RobotError: The robot has no arms.
        """
        arms = arms_of(robot)
        size = float(np.mean([arm.reach for arm in arms])) / REACH
        fronts = _fronts(arms)
        middles = np.array([arm.base + AHEAD * size * front for arm, front in zip(arms, fronts, strict=True)])
        bases, middle = np.mean([arm.base for arm in arms], axis=0), middles.mean(axis=0)
        front = middle - bases
        front = front if np.linalg.norm(front[:2]) > LEVEL * size else fronts[0]
        pose = turn("z", float(np.arctan2(front[1], front[0])))
        pose[:3, 3] = middle - AHEAD * size * pose[:3, 0]
        pose[2, 3] = bases[2] - (HANGING if all(arm.hangs for arm in arms) else BASE) * size
        cell = cls(robot, arms, pose, size, (), (), ())
        shoulders = cell.inward(np.array([arm.base for arm in arms])) + (0.0, 0.0, SHOULDER - BASE)
        regions = cell.inward(middles + INWARD * (middle - middles))[:, :2].tolist()
        reaches = tuple(SENT * arm.reach / (REACH * size) for arm in arms)
        return replace(cell, shoulders=tuple(shoulders), middles=tuple((x, y) for x, y in regions), reaches=reaches)

    @cached_property
    def tables(self) -> ArmTables:
        """The kernel's tables of the robot with empty hands."""
        return self.holding(())

    def holding(self, attached: Sequence[AttachedObject]) -> ArmTables:
        """Return the kernel's tables of the robot with held objects."""
        return ArmTables.of(self.robot, attached, own_margin=self.pose is None)

    @cached_property
    def fixtures(self) -> tuple[Solids, ...]:
        """The robot's fixtures as solids of the kernel."""
        return tuple(Solids.of(primitives(*world_geometry(body))) for body in self.robot.fixtures)

    def outward(self, parts: Parts) -> Parts:
        """Return parts of the frame as they are in the world."""
        return parts if self.pose is None else place(scale(parts, self.size), self.pose)

    def obstacle(self, obstacle: Obstacle) -> Obstacle:
        """Return a primitive of the frame as it is in the world, under the same name."""
        if self.pose is None:
            return obstacle
        (moved,) = obstacles(self.outward([part_of(obstacle)]))
        return moved.model_copy(update={"name": obstacle.name})

    def inward(self, points: Array) -> Array:
        """Return points in the world, shape (n, 3) [m], as they are in the frame."""
        return points if self.pose is None else np.asarray((points - self.pose[:3, 3]) @ self.pose[:3, :3] / self.size)

    def region(self, region: HandRegion) -> Region:
        """Return a region of the frame as it is in the world."""
        return region if self.pose is None else _Moved(region, self.pose, self.size)

    def wide_region(self, arm: int) -> Region:
        """Return the region of a tip: before its arm, and somewhat toward the other arms."""
        x, y = self.middles[arm]
        return self.region(HandRegion((x - 0.25, x + 0.25), (y - 0.5, y + 0.5), (0.1, 0.8), FINGERS))

    def in_reach(self, point: Array, arm: int) -> bool:
        """Whether an arm is sent to a place in the frame: one above the tables and before the robot."""
        x, _, z = point
        near = np.linalg.norm(point - self.shoulders[arm]) < self.reaches[arm]
        return bool(x > 0.15 and 0.03 < z < 1.05 and near)


@dataclass(frozen=True)
class _Moved:
    """A region of a cell's frame in the world."""

    region: HandRegion
    pose: Array
    size: float

    def sample(self, rng: np.random.Generator) -> tuple[Array, Direction]:
        """Return a point, shape (3,) [m], and a direction of the fingers."""
        point, fingers = self.region.sample(rng)
        x, y, z = (float(v) for v in self.pose[:3, :3] @ np.asarray(fingers))
        return self.pose[:3, :3] @ (self.size * point) + self.pose[:3, 3], (x, y, z)


def _fronts(arms: Sequence[Arm]) -> list[Array]:
    """Return the horizontal unit direction in which each arm works.

    It is that of its tip at home where all of them agree, or where each points to the middle of the arms; else x.
    """
    found, middle = list[Array](), np.mean([arm.base for arm in arms], axis=0)
    for arm in arms:
        way = (arm.tip - arm.base) * (1.0, 1.0, 0.0)
        length = np.linalg.norm(way)
        found.append(np.asarray(way / length if length > LEVEL * arm.reach else np.eye(3)[0]))
    agree = np.linalg.norm(np.mean(found, axis=0)) > AGREED
    inward = [(middle - arm.base) @ front > AGREED * np.linalg.norm(middle - arm.base)
              for arm, front in zip(arms, found, strict=True)]  # fmt: skip
    return found if agree or all(inward) else [np.eye(3)[0]] * len(arms)


@cache
def standard_cell() -> Cell:
    """Return the cell of the robot of the suites, whose frame is that of the world."""
    shoulders = tuple(np.array([0.0, y, SHOULDER]) for y in SHOULDERS)
    middles = tuple((AHEAD, (1.0 - INWARD) * y) for y in SHOULDERS)
    return Cell(robot(), arms_of(robot()), None, 1.0, shoulders, middles, (SENT, SENT))


@weakly_cached
def cell_of(robot: Robot) -> Cell:
    """Return the cell of a robot, made once per robot.

    Raises:
        RobotError: The robot has no arms.
    """
    return standard_cell() if robot is standard_cell().robot else Cell.of(robot)
