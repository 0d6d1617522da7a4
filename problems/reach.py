"""Where hands are to be, and free states that put them there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import world_geometry
from apex_ompl.collision.tabulate import primitives, tabulate_scene
from apex_ompl.kernel import Kernel, RobotTables, offset_target, opposition_target
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.tasks.inverse_kinematics import Links, in_world
from apex_ompl.types import Array

Range = tuple[float, float]
Direction = tuple[float, float, float]

ROBOT = "dual_panda_softhand"
MARGIN = 0.01  # clearance of every start and goal [m]
REACHED = 1e-3  # residual of a hand pose that counts as reached [m, and of unit vectors]
SPREAD = 0.6  # of the states that descents begin at, around home [rad]
DESCENTS, KEPT, STEPS = 32, 4, 40  # descents for a hand at once, states of an arm to combine, steps of a descent


@cache
def robot() -> Robot:
    """Return the robot of the suites."""
    return load_robot(ROBOT)


@cache
def sides() -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the joints of the left arm and hand, and those of the right ones."""
    names = robot().joint_names
    return tuple(tuple(k for k, name in enumerate(names) if name.startswith(side)) for side in ("left_", "right_"))


@cache
def bare_tables() -> RobotTables:
    """Return the kernel's tables of the robot with empty hands."""
    return CollisionChecker(robot()).kernel.robot


@cache
def arm_tables() -> tuple[RobotTables, ...]:
    """Return tables that judge one arm each, with its hand."""
    return tuple(bare_tables().restricted_to(joints) for joints in sides())


def scene_kernel(tables: RobotTables, scene: Sequence[Obstacle]) -> Kernel:
    """Return the kernel for the robot among its tables and obstacles, which stand where they are at time 0."""
    solids = {n: primitives(*world_geometry(body)) for n, body in enumerate((*robot().fixtures, *scene))}
    return Kernel(tables, tabulate_scene(solids))


def keeps_clear(kernel: Kernel, states: Array, margin: float = MARGIN) -> NDArray[np.bool_]:
    """Whether the sphere covers prove a margin [m] for states, shape (N, dof); shape (N,)."""
    clear: NDArray[np.bool_] = kernel.clearance(states, margin).min(axis=1) >= margin
    return clear


@dataclass(frozen=True)
class Region:
    """A box that the point between a hand's fingers is to be in [m], and the directions its fingers may point."""

    x: Range
    y: Range
    z: Range
    fingers: tuple[Direction, ...]

    def draw(self, rng: np.random.Generator) -> tuple[Array, Direction]:
        """Return a point of the box, shape (3,) [m], and a direction."""
        point = np.array([rng.uniform(*side) for side in (self.x, self.y, self.z)])
        return point, self.fingers[int(rng.integers(len(self.fingers)))]


class HandPoses:
    """Free states of a scene with both hands in regions; one arm is placed, then the other."""

    def __init__(self, scene: Sequence[Obstacle]) -> None:
        """Look for states among ``scene`` and the robot's tables."""
        self.robot = robot()
        self.kernel = scene_kernel(bare_tables(), scene)
        self._arms = [Kernel(tables, self.kernel.scene) for tables in arm_tables()]
        self._hands = self.robot.groups["hands"]

    def draw(
        self, rng: np.random.Generator, regions: tuple[Region, Region], hands: Range, tries: int = 4
    ) -> Array | None:
        """Return a state with the left and the right hand in their regions and a margin all around, or None.

        Args:
            rng: Source of targets and of the states that descents begin at.
            regions: Of the left and of the right hand.
            hands: Range of the synergies.
            tries: How many targets to try.

        Returns:
            Shape (dof,), rounded to a millionth of a radian.
        """
        for _ in range(tries):
            found = [self._arm(rng, arm, region, hands) for arm, region in enumerate(regions)]
            if not (len(found[0]) and len(found[1])):
                continue
            both = np.repeat(found[0], len(found[1]), axis=0)
            right = list(sides()[1])
            both[:, right] = np.tile(found[1], (len(found[0]), 1))[:, right]
            good = np.flatnonzero(keeps_clear(self.kernel, both))
            if len(good):
                return np.array(both[good[0]])
        return None

    def _arm(self, rng: np.random.Generator, arm: int, region: Region, hands: Range) -> Array:
        """Return up to ``KEPT`` states in which one hand is in its region and its arm clear of all but the other."""
        links, hand = Links.of(self.robot), list(self.robot.hands.values())[arm]
        point, fingers = region.draw(rng)
        targets = [
            offset_target(in_world(point), links.point(hand.palm, hand.point)),
            opposition_target(links.direction(hand.palm, hand.fingers), in_world(fingers), -1.0),
        ]
        states = self.robot.home + rng.normal(0.0, SPREAD, (DESCENTS, self.robot.dof))
        states[:, self._hands] = rng.uniform(*hands, (DESCENTS, len(self._hands)))
        ends = links.inverse(targets).descend(states, tolerance=REACHED, max_steps=STEPS)
        reached = np.round(ends.states[ends.errors <= REACHED], 6)
        reached = reached[[self.robot.limit_fault(q) is None for q in reached]] if len(reached) else reached
        clear = keeps_clear(self._arms[arm], reached) if len(reached) else np.zeros(0, bool)
        return np.array(reached[clear][:KEPT])
