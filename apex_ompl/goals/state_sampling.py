"""Sampling of collision-free states by inverse kinematics: both hands in given regions, or two held objects aligned."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.collision.tables import primitives
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.goals.alignment import RESTART_SPREAD, AlignmentGoal
from apex_ompl.goals.grasp import HandObjects, close_hands
from apex_ompl.kernel import Kernel, RobotTables, SceneTables, offset_target, opposition_target
from apex_ompl.kernel.scene_builder import Solids, tables_of
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Alignment
from apex_ompl.types import Array

Interval = tuple[float, float]
Synergies = tuple[float | Array, float | Array]
Direction = tuple[float, float, float]

POSE_TOLERANCE = 1e-3  # largest residual of a hand pose that counts as reached [m, and of unit vectors]
SEED_SPREAD = 0.6  # standard deviation of the seeds of inverse kinematics around home [rad]
SEEDS = 32  # descents for one hand
DESCENT_STEPS = 40  # most steps of a descent of inverse kinematics
MAX_ARM_STATES = 4  # states of one arm that are combined with those of the other arm
BATCH = 32  # states sampled at once
RESIDUAL_TOLERANCE = 1e-3  # largest residual of an aligned state that counts as reached


def scene_kernel(robot: Robot, tables: RobotTables, scene: Sequence[Obstacle]) -> Kernel:
    """Return the kernel for ``tables`` of a robot among its fixtures and obstacles; moving ones are at time 0."""
    bodies = enumerate((*robot.fixtures, *scene))
    return Kernel(tables, tables_of({n: Solids.of(primitives(*world_geometry(body))) for n, body in bodies}))


def has_clearance(kernel: Kernel, states: Array, margin: float) -> NDArray[np.bool_]:
    """Whether states have a clearance of at least ``margin``, to the scene and between bodies of the robot.

    The spheres contain the bodies, so that the true clearance is at least the one tested.

    Args:
        kernel: The robot in its scene.
        states: Shape (N, dof).
        margin: [m].

    Returns:
        Shape (N,).
    """
    clear: NDArray[np.bool_] = kernel.clearance(states, margin).min(axis=1) >= margin
    return clear


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
        both: Tables of the whole robot, with the objects that it holds.
        arms: Tables that check the left arm with its hand, and the right one, and ignore all other bodies.
        joints: Numbers of the joints of the left arm and hand, and of the right ones.
    """

    robot: Robot
    both: RobotTables
    arms: tuple[RobotTables, RobotTables]
    joints: tuple[tuple[int, ...], tuple[int, ...]]

    @classmethod
    def of(cls, robot: Robot) -> DualArmTables:
        """Return the tables of a robot whose joint names start with ``left_`` or ``right_``."""
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
            tables: The robot with the objects that it holds.
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
            attempts: Number of pairs of targets to try.

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


class AlignmentSampler:
    """Sampler of starts and goals for objects in both hands that are to be aligned; there are no obstacles.

    Attributes:
        robot: The robot.
        attached: The held objects.
        home: The home state with the synergies that hold the objects, shape (dof,).
        goal: The alignment.
        tables: Kernel tables of the robot with the objects. The pair of the two objects is left out: at a goal they
            are closer than the margin.
        kernel: ``tables`` among the robot's fixtures.
    """

    def __init__(self, robot: Robot, objects: HandObjects, alignment: Alignment, margin: float) -> None:
        """Close the hands on ``objects``; states have a clearance of ``margin`` [m] to fixtures and between bodies."""
        self.robot = robot
        self.margin = margin
        self.attached, self.home, _ = close_hands(robot, objects)
        self.goal = AlignmentGoal(robot, alignment, self.attached, self.home)
        # This checker includes the pair of the two objects, by their meshes and without a margin.
        self._checker = CollisionChecker(robot, (), self.attached)
        first, second = (body.name for body in self.attached)
        self.tables = self._checker.kernel.robot.without_pair(first, second)
        self.kernel = scene_kernel(robot, self.tables, ())
        self._inverse = Links.of(robot).inverse(self.goal.targets(), robot.groups["hands"])
        self._corners = [self._box_corners(body) for body in self.attached]

    def _box_corners(self, body: AttachedObject) -> tuple[int, Array]:
        """Return the joint that carries an object, and its bounding box's corners in that frame, shape (8, 3) [m]."""
        shape = coal_geometry(body)
        shape.computeLocalAABB()
        low, high = shape.aabb_local.min_, shape.aabb_local.max_
        corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
        links = Links.of(self.robot)
        fixed = [links.point(body.link, body.pose[:3, :3] @ corner + body.pose[:3, 3]) for corner in corners]
        return fixed[0].joint, np.array([f.vector for f in fixed])

    def box_corners(self, states: Array) -> Array:
        """Return corners of the objects' bounding boxes in the world at states (N, dof); shape (N, 2, 8, 3) [m]."""
        rotation, origin = self.kernel.joint_frames(states)
        corners = [
            local @ np.swapaxes(rotation[:, joint], 1, 2) + origin[:, joint, None] for joint, local in self._corners
        ]
        return np.stack(corners, axis=1)

    def sample_start(
        self, rng: np.random.Generator, spread: float, min_height: float, min_separation: float
    ) -> Array | None:
        """Return a free start, or None when no state of a batch is one.

        Args:
            rng: Source of the states home + N(0, spread^2).
            spread: Standard deviation of the joints of the arms [rad].
            min_height: Of the lowest corner of the objects' bounding boxes above z = 0 [m].
            min_separation: Of the centers of the two boxes [m].

        Returns:
            Shape (dof,), rounded to a millionth of a radian.
        """
        states = np.round(self._around_home(rng, spread), 6)
        corners = self.box_corners(states)
        centers = corners.mean(axis=2)
        separation = np.linalg.norm(centers[:, 0] - centers[:, 1], axis=1)
        height = corners[..., 2].min(axis=(1, 2))
        candidates = states[self._within_limits(states) & (height >= min_height) & (separation >= min_separation)]
        clear = (q for q in candidates if has_clearance(self.kernel, q, self.margin)[0])
        return next((q for q in clear if self._checker.is_free(q)), None)

    def sample_goal(self, rng: np.random.Generator) -> Array | None:
        """Return a free state that satisfies the alignment, or None when no descent of a batch ends at one.

        Args:
            rng: Source of the seeds home + N(0, ``RESTART_SPREAD``^2) of inverse kinematics.

        Returns:
            Shape (dof,), rounded to a millionth of a radian.
        """
        limits = self.robot.limits
        seeds = np.clip(self._around_home(rng, RESTART_SPREAD), limits.lower, limits.upper)
        descents = self._inverse.descend(seeds, max_steps=DESCENT_STEPS)
        states = np.round(descents.states[descents.errors < RESIDUAL_TOLERANCE], 6)
        states = states[self._within_limits(states)]
        clear = states[has_clearance(self.kernel, states, self.margin)]
        return next((q for q in clear if self.goal.is_satisfied(q) and self._checker.is_free(q)), None)

    def _around_home(self, rng: np.random.Generator, spread: float) -> Array:
        """Return states home + N(0, spread^2) with the hands as at home, shape (BATCH, dof)."""
        states = self.home + rng.normal(0.0, spread, (BATCH, self.robot.dof))
        hands = self.robot.groups["hands"]
        states[:, hands] = self.home[hands]
        return np.asarray(states)

    def _within_limits(self, states: Array) -> NDArray[np.bool_]:
        limits = self.robot.limits
        return np.asarray(((states >= limits.lower) & (states <= limits.upper)).all(axis=1), bool)
