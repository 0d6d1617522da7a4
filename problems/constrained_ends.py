"""Starts and goals on a constraint: both palms at given poses, by inverse kinematics of one arm after the other.

Each arm is placed by itself from random seeds, so that its states are on several branches; then the states of both arms
are combined. What the hands carry is held exactly: residuals end below 1e-9, and joints are rounded to a millionth of a
radian.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.links import Links, in_world
from apex_ompl.constraints.paths import ConstrainedPaths
from apex_ompl.goals.pose_goal import POSITION_WEIGHT
from apex_ompl.goals.state_sampling import has_clearance
from apex_ompl.kernel import IKSolver, Kernel, SceneTables, offset_target, opposition_target
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.problems.constrained_held import Carried, upright_palm
from apex_ompl.problems.suite_robot import robot
from apex_ompl.types import Array, Flags

SEEDS = 32  # descents for one arm
SEED_SPREAD = 0.7  # standard deviation of half of the seeds around home [rad]
NEAR_SPREAD = 0.5  # of the other half around a given state [rad]
EXACT = 1e-9  # residual at which a descent ends [m, and of unit vectors]
REACHED = 1e-8  # largest residual that counts as reached
STEPS = 60  # most steps of a descent
ARM_STATES = 8  # of one arm that are combined with those of the other one
LIMIT_GAP = 0.02  # of arm joints to their limits, where a closed chain ends [rad]
TREE_ITERATIONS = 400  # in which trees are to join start and goal
LINE_STATES = 15  # at which the straight line is looked up, between start and goal
LINE_MARGIN = 1e-6  # clearance of these states [m]


class PalmSampler:
    """Sampler of states with both palms at given poses, clear of a scene by a margin."""

    def __init__(self, carried: Carried, scene: SceneTables, margin: float) -> None:
        """Prepare the kernels; states keep ``margin`` [m] to the scene and between bodies of the robot."""
        held = carried.held
        self._held, self._margin = held, margin
        self._kernel = Kernel(held.tables.whole, scene)
        self._arms = [Kernel(arm, scene) for arm in held.tables.alone]
        self._right = list(held.tables.arms[1].joints)

    def sample(self, rng: np.random.Generator, palms: Sequence[Array], near: Array | None = None) -> Array:
        """Return states with the palms at poses, on several branches, shape (n, dof); none where none was found.

        Args:
            rng: Source of the seeds.
            palms: Pose of the left and of the right palm in the world, shape (4, 4) each [m].
            near: State around which half of the seeds are drawn, shape (dof,).
        """
        left, right = (self._arm(rng, side, palms[side], near) for side in (0, 1))
        both = np.repeat(left, len(right), axis=0)
        both[:, self._right] = np.tile(right, (len(left), 1))[:, self._right]
        return both[has_clearance(self._kernel, both, self._margin)] if len(both) else both

    def _arm(self, rng: np.random.Generator, side: int, palm: Array, near: Array | None) -> Array:
        """Return states of one arm whose palm has a pose; the other arm is ignored."""
        some = robot()
        seeds = some.home + rng.normal(0.0, SEED_SPREAD, (SEEDS, some.dof))
        if near is not None:
            seeds[::2] = near + rng.normal(0.0, NEAR_SPREAD, (len(seeds[::2]), some.dof))
        seeds[:, some.groups["hands"]] = self._held.low
        seeds = np.clip(seeds, some.limits.lower, some.limits.upper)
        descents = _arm_inverse(side, palm).descend(seeds, tolerance=EXACT, max_steps=STEPS)
        states = np.round(descents.states[descents.errors < REACHED], 6)
        states = states[inside_limits(states)]
        if not len(states):
            return states
        if near is not None:
            arm = list(self._held.tables.arms[side].joints)
            states = states[np.abs(states - near)[:, arm].max(axis=1).argsort(kind="stable")]
        return states[has_clearance(self._arms[side], states, self._margin)][:ARM_STATES]


def _arm_inverse(side: int, pose: Array) -> IKSolver:
    """Return the inverse kinematics of one palm at a pose in the world, shape (4, 4) [m]."""
    links, palm = Links.of(robot()), tuple(robot().hands.values())[side].palm
    targets = [offset_target(in_world(pose[:3, 3]), links.point(palm, (0.0, 0.0, 0.0)), weight=POSITION_WEIGHT)]
    for k in (0, 2):
        targets.append(opposition_target(links.direction(palm, np.eye(3)[k]), in_world(pose[:3, k]), -1.0))
    return links.inverse(targets, robot().groups["hands"])


def inside_limits(states: Array) -> Flags:
    """Whether the arm joints of states keep ``LIMIT_GAP`` to their limits, shape (N,)."""
    some = robot()
    arms = [k for name in ("left_arm", "right_arm") for k in some.groups[name]]
    low, high = some.limits.lower[arms] + LIMIT_GAP, some.limits.upper[arms] - LIMIT_GAP
    return np.asarray(((states[:, arms] >= low) & (states[:, arms] <= high)).all(axis=1), bool)


def line_is_free(carried: Carried, scene: SceneTables, ends: Array) -> bool:
    """Whether the straight line, its states moved to the constraints, is clear of a scene.

    Args:
        carried: What is carried, under which constraints.
        scene: The kernel's tables of the scene.
        ends: Start and goal, shape (2, dof).
    """
    constraints = ConstraintSet.of(robot(), carried.constraints, carried.held.attached, ends[0])
    line = np.linspace(ends[0], ends[1], LINE_STATES + 2)[1:-1]
    moved = constraints.project(line)
    kernel = Kernel(carried.held.tables.whole, scene)
    return bool(moved.ok.all()) and bool(has_clearance(kernel, moved.states, LINE_MARGIN).all())


def are_joined(carried: Carried, ends: Array) -> bool:
    """Whether trees on the constraints join start and goal, shape (2, dof), without obstacles.

    States of a closed chain may lie in parts that joint limits and the robot itself keep apart.
    """
    constraints = ConstraintSet.of(robot(), carried.constraints, carried.held.attached, ends[0])
    kernel = Kernel(carried.held.tables.whole, scene_tables([]))
    paths = ConstrainedPaths(kernel, constraints, Optimizer(), lambda states: True)
    trees = paths.trees(ends[:1], ends[1:], np.random.default_rng(0))
    return trees is not None and trees.grow(TREE_ITERATIONS) is not None


def palms_at(carried: Carried, pose: Array) -> list[Array]:
    """Return the poses of both palms that hold a tray at a pose in the world, shape (4, 4) [m]."""
    assert carried.tray is not None
    return [pose @ carried.tray.palm(side) for side in (0, 1)]


def palms_with_cups(points: Sequence[Array], yaws: Sequence[float]) -> list[Array]:
    """Return the poses of both palms with upright cups, shape (4, 4) each [m].

    Args:
        points: Grasp points in the world, shape (3,) each [m].
        yaws: Angles of the fingers about up, from forward [rad].
    """
    found = []
    for side, (hand, point, yaw) in enumerate(zip(robot().hands.values(), points, yaws, strict=True)):
        pose = np.eye(4)
        pose[:3, :3] = upright_palm(side, np.array([np.cos(yaw), np.sin(yaw), 0.0]))
        pose[:3, 3] = point - pose[:3, :3] @ hand.point
        found.append(pose)
    return found
