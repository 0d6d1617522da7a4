"""Sampling of collision-free states by inverse kinematics: all hands in given regions, or two held objects aligned."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry, world_geometry
from apex_ompl.collision.tables import primitives
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.goals.alignment import RESTART_SPREAD, AlignmentGoal
from apex_ompl.goals.arms import Arm, arms_of
from apex_ompl.goals.grasp import HandObjects, close_hands
from apex_ompl.kernel import Kernel, RobotTables, SceneTables, Target, offset_target, opposition_target
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
OTHERS_SPREAD = 0.15  # the same for joints that belong to no arm, which are not moved by it [rad, m]
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


class Region(Protocol):
    """Where the tip of an arm is sent, such as a :class:`HandRegion`."""

    def sample(self, rng: np.random.Generator) -> tuple[Array, Direction]:
        """Return a point, shape (3,) [m], and a unit direction of the fingers, in the world."""
        ...


@dataclass(frozen=True, eq=False)
class ArmTables:
    """Kernel tables of a robot: of all of it, and of each arm alone.

    Attributes:
        robot: The robot.
        arms: Its arms.
        whole: Tables of the whole robot, with the objects that it holds.
        alone: Tables that check one arm with its hand, and ignore the bodies of the others, for each arm.
        others: Indices of the planned joints that belong to no arm, such as a torso's.
        synergies: Indices of the joints that close the hands.
        own_margin: Whether bodies of the robot keep a margin from one another, too; else they are proved apart.
    """

    robot: Robot
    arms: tuple[Arm, ...]
    whole: RobotTables
    alone: tuple[RobotTables, ...]
    others: tuple[int, ...]
    synergies: tuple[int, ...]
    own_margin: bool

    @classmethod
    def of(cls, robot: Robot, attached: Sequence[AttachedObject] = (), *, own_margin: bool) -> ArmTables:
        """Return the tables of a robot and the objects that it holds.

        Args:
            robot: The robot.
            attached: The objects.
            own_margin: Whether bodies of the robot keep a margin from one another.

        Raises:
            RobotError: The robot has no arms.
        """
        arms = arms_of(robot)
        others = tuple(sorted(set(range(robot.dof)).difference(*(arm.joints for arm in arms))))
        whole = CollisionChecker(robot, (), attached).kernel.robot
        alone = tuple(whole.restricted_to((*arm.joints, *others)) for arm in arms)
        names = (robot.hands[arm.hand].synergy for arm in arms if arm.hand is not None)
        synergies = tuple(robot.joint_names.index(name) for name in names if name is not None)
        return cls(robot, arms, whole, alone, others, synergies, own_margin)

    def are_clear(self, kernel: Kernel, states: Array, margin: float) -> NDArray[np.bool_]:
        """Whether states keep a margin to the scene and, where ``own_margin``, between bodies of the robot.

        Args:
            kernel: Some of the tables in a scene.
            states: Shape (N, dof).
            margin: [m].

        Returns:
            Shape (N,).
        """
        if self.own_margin or not len(states):
            return has_clearance(kernel, states, margin)
        return np.asarray((kernel.clearance(states, margin)[:, 0] >= margin) & (kernel.unproved(states)[1] == 0))


class HandPoseSampler:
    """Sampler of states with the tips of all arms in regions of one scene.

    Each arm is placed by itself: descents of inverse kinematics from random seeds, of which those are kept that leave
    the arm a margin to the scene. Then every kept state of an arm is combined with every one of the others, and the
    first combination with the margin is returned. Arms of few joints reach points, in any direction.
    """

    def __init__(self, tables: ArmTables, scene: Sequence[Obstacle] | SceneTables, margin: float) -> None:
        """Prepare the kernels of a scene; states keep ``margin`` [m] to obstacles, fixtures and between bodies.

        Args:
            tables: The robot with the objects that it holds.
            scene: Obstacles beside the robot's fixtures, or the kernel's tables of both.
            margin: [m].
        """
        self.robot = tables.robot
        self.margin = margin
        self._tables = tables
        if isinstance(scene, SceneTables):
            self._kernel = Kernel(tables.whole, scene)
        else:
            self._kernel = scene_kernel(self.robot, tables.whole, scene)
        self._arm_kernels = [Kernel(arm, self._kernel.scene) for arm in tables.alone]

    def sample(
        self, rng: np.random.Generator, regions: Sequence[Region], synergies: Synergies, attempts: int = 4
    ) -> Array | None:
        """Return a state with the tip of each arm in its region, or None when none was found.

        Args:
            rng: Source of targets and seeds.
            regions: Of the arms.
            synergies: Least and largest synergy of all hands that close, or of each.
            attempts: Number of targets to try for each arm.

        Returns:
            Shape (dof,), rounded to a millionth of a radian.
        """
        others = self._tables.others
        for _ in range(attempts):
            rest = self._rest(rng) if others else self.robot.home
            found = [self._sample_arm(rng, arm, region, synergies, rest) for arm, region in enumerate(regions)]
            if not all(map(len, found)):
                continue
            states = found[0]
            for arm, own in zip(self._tables.arms[1:], found[1:], strict=True):
                states = _combined(states, own, arm)
            clear = np.flatnonzero(self._tables.are_clear(self._kernel, states, self.margin))
            if len(clear):
                return np.array(states[clear[0]])
        return None

    def _rest(self, rng: np.random.Generator) -> Array:
        """Return a state around home, shape (dof,)."""
        limits, spread = self.robot.limits, rng.normal(0.0, OTHERS_SPREAD, self.robot.dof)
        return np.asarray(np.round(np.clip(self.robot.home + spread, limits.lower, limits.upper), 6))

    def _sample_arm(
        self, rng: np.random.Generator, number: int, region: Region, synergies: Synergies, rest: Array
    ) -> Array:
        """Return up to ``MAX_ARM_STATES`` states with one tip in its region; the other arms are ignored.

        Args:
            rng: Source of the target and the seeds.
            number: Number of the arm.
            region: Where its tip is sent.
            synergies: See :meth:`sample`.
            rest: State of the joints that belong to no arm, shape (dof,).
        """
        links, arm, tables = Links.of(self.robot), self._tables.arms[number], self._tables
        point, fingers = region.sample(rng)
        targets: list[Target] = [offset_target(in_world(point), links.point(arm.link, arm.point))]
        if arm.is_pointed:
            targets.append(opposition_target(links.direction(arm.link, arm.fingers), in_world(fingers), -1.0))
        seeds = self.robot.home + rng.normal(0.0, SEED_SPREAD, (SEEDS, self.robot.dof))
        seeds[:, tables.synergies] = rng.uniform(*synergies, (SEEDS, len(tables.synergies)))
        seeds[:, tables.others] = rest[list(tables.others)]
        solver = links.inverse(targets, tables.others)
        descents = solver.descend(seeds, tolerance=POSE_TOLERANCE, max_steps=DESCENT_STEPS)
        ends = self.robot.turned_to(descents.states[descents.errors <= POSE_TOLERANCE], self.robot.home)
        reached = np.round(ends, 6)
        if not len(reached):
            return reached
        reached = reached[[self.robot.limit_fault(q) is None for q in reached]]
        if not len(reached):
            return reached
        clear = tables.are_clear(self._arm_kernels[number], reached, self.margin)
        return np.array(reached[clear][:MAX_ARM_STATES])


def _combined(states: Array, own: Array, arm: Arm) -> Array:
    """Return every state with the joints of an arm as in every state of ``own``."""
    found, mine = states[np.repeat(np.arange(len(states)), len(own))], list(arm.joints)
    found[:, mine] = np.tile(own, (len(states), 1))[:, mine]
    return found


def _hand_joints(robot: Robot) -> tuple[int, ...]:
    """Return the places in a state of the joints that close hands."""
    names = (hand.synergy for hand in robot.hands.values())
    return tuple(robot.joint_names.index(name) for name in names if name is not None)


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
        self._inverse = Links.of(robot).inverse(self.goal.targets(), _hand_joints(robot))
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
        states = np.round(self.robot.turned_to(descents.states[descents.errors < RESIDUAL_TOLERANCE], self.home), 6)
        states = states[self._within_limits(states)]
        clear = states[has_clearance(self.kernel, states, self.margin)]
        return next((q for q in clear if self.goal.is_satisfied(q) and self._checker.is_free(q)), None)

    def _around_home(self, rng: np.random.Generator, spread: float) -> Array:
        """Return states home + N(0, spread^2) with the hands as at home, shape (BATCH, dof)."""
        states = self.home + rng.normal(0.0, spread, (BATCH, self.robot.dof))
        hands = list(_hand_joints(self.robot))
        states[:, hands] = self.home[hands]
        return np.asarray(states)

    def _within_limits(self, states: Array) -> NDArray[np.bool_]:
        limits = self.robot.limits
        return np.asarray(((states >= limits.lower) & (states <= limits.upper)).all(axis=1), bool)
