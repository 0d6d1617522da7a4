"""Sampling of collision-free states with both hands in given regions, by inverse kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.goals.cover_clearance import has_clearance, scene_kernel
from apex_ompl.goals.inverse_kinematics import Links, in_world
from apex_ompl.kernel import Kernel, RobotTables, SceneTables, offset_target, opposition_target
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.types import Array

Interval = tuple[float, float]
Synergies = tuple[float | Array, float | Array]
Direction = tuple[float, float, float]

POSE_TOLERANCE = 1e-3  # largest residual of a hand pose that counts as reached [m, and of unit vectors]
SEED_SPREAD = 0.6  # standard deviation of the seeds of inverse kinematics around home [rad]
SEEDS, DESCENT_STEPS = 32, 40  # descents for one hand, and the most steps of each
MAX_ARM_STATES = 4  # states of one arm that are combined with those of the other arm


@dataclass(frozen=True)
class HandRegion:
    """Target region of a hand.

    Attributes:
        x: Interval of the grasp point, the point between the fingers, in the world [m].
        y: As ``x``.
        z: As ``x``.
        fingers: Unit directions in the world; the fingers point along one of them.
    """

    x: Interval
    y: Interval
    z: Interval
    fingers: tuple[Direction, ...]

    def sample(self, rng: np.random.Generator) -> tuple[Array, Direction]:
        """Return a grasp point, shape (3,) [m], and a direction of the fingers."""
        point = np.array([rng.uniform(*interval) for interval in (self.x, self.y, self.z)])
        return point, self.fingers[int(rng.integers(len(self.fingers)))]


@dataclass(frozen=True, eq=False)
class DualArmTables:
    """Kernel tables of a robot with empty hands: of both arms, and of each arm alone.

    Attributes:
        robot: The robot.
        both: Tables of the whole robot, with what it holds.
        arms: Tables that check the left arm with its hand, and the right one, and ignore all other bodies.
        joints: Numbers of the joints of the left arm and hand, and of the right ones.
    """

    robot: Robot
    both: RobotTables
    arms: tuple[RobotTables, RobotTables]
    joints: tuple[tuple[int, ...], tuple[int, ...]]

    @classmethod
    def of(cls, robot: Robot) -> DualArmTables:
        """Return the tables of a robot, the names of whose joints begin with ``left_`` or ``right_``."""
        left, right = (
            tuple(k for k, name in enumerate(robot.joint_names) if name.startswith(side))
            for side in ("left_", "right_")
        )
        both = CollisionChecker(robot).kernel.robot
        return cls(robot, both, (both.restricted_to(left), both.restricted_to(right)), (left, right))


class HandPoseSampler:
    """Sampler of states with both hands in regions of one scene.

    Each arm is placed by itself: descents of inverse kinematics from random seeds, of which those are kept that leave
    the arm a margin to the scene. Then every kept state of the left arm is combined with every one of the right arm,
    and the first combination with the margin is returned.
    """

    def __init__(self, tables: DualArmTables, scene: Sequence[Obstacle] | SceneTables, margin: float) -> None:
        """Prepare the kernels of a scene; states keep ``margin`` [m] to obstacles, fixtures and between bodies.

        Args:
            tables: The robot with what it holds.
            scene: Obstacles beside the robot's fixtures, or the kernel's tables of both.
            margin: [m].
        """
        self.robot = tables.robot
        self.margin = margin
        self._joints = tables.joints
        self._hands = self.robot.groups["hands"]
        if isinstance(scene, SceneTables):
            self._kernel = Kernel(tables.both, scene)
        else:
            self._kernel = scene_kernel(self.robot, tables.both, scene)
        self._arm_kernels = [Kernel(arm, self._kernel.scene) for arm in tables.arms]

    def sample(
        self,
        rng: np.random.Generator,
        regions: tuple[HandRegion, HandRegion],
        synergies: Synergies,
        attempts: int = 4,
    ) -> Array | None:
        """Return a state with the left and the right hand in their regions, or None when none was found.

        Args:
            rng: Source of targets and seeds.
            regions: Of the left and of the right hand.
            synergies: Least and largest synergy of both hands, or of each, shape (2,).
            attempts: How many pairs of targets to try.

        Returns:
            Shape (dof,), rounded to a millionth of a radian.
        """
        right_joints = list(self._joints[1])
        for _ in range(attempts):
            left, right = [self._sample_arm(rng, arm, region, synergies) for arm, region in enumerate(regions)]
            if not (len(left) and len(right)):
                continue
            both = np.repeat(left, len(right), axis=0)
            both[:, right_joints] = np.tile(right, (len(left), 1))[:, right_joints]
            clear = np.flatnonzero(has_clearance(self._kernel, both, self.margin))
            if len(clear):
                return np.array(both[clear[0]])
        return None

    def _sample_arm(self, rng: np.random.Generator, arm: int, region: HandRegion, synergies: Synergies) -> Array:
        """Return up to ``MAX_ARM_STATES`` states with one hand in its region; the other arm is ignored."""
        links, hand = Links.of(self.robot), list(self.robot.hands.values())[arm]
        point, fingers = region.sample(rng)
        targets = [
            offset_target(in_world(point), links.point(hand.palm, hand.point)),
            opposition_target(links.direction(hand.palm, hand.fingers), in_world(fingers), -1.0),
        ]
        seeds = self.robot.home + rng.normal(0.0, SEED_SPREAD, (SEEDS, self.robot.dof))
        seeds[:, self._hands] = rng.uniform(*synergies, (SEEDS, len(self._hands)))
        descents = links.inverse(targets).descend(seeds, tolerance=POSE_TOLERANCE, max_steps=DESCENT_STEPS)
        reached = np.round(descents.states[descents.errors <= POSE_TOLERANCE], 6)
        if not len(reached):
            return reached
        reached = reached[[self.robot.limit_fault(q) is None for q in reached]]
        if not len(reached):
            return reached
        return np.array(reached[has_clearance(self._arm_kernels[arm], reached, self.margin)][:MAX_ARM_STATES])
