"""Sampling of collision-free starts and goals for the alignment of two held objects."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.goals.alignment import RESTART_SPREAD, AlignmentGoal
from apex_ompl.goals.cover_clearance import has_clearance, scene_kernel
from apex_ompl.goals.grasp import HandObjects, close_hands
from apex_ompl.goals.inverse_kinematics import Links
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.scene.problem import Alignment
from apex_ompl.types import Array

BATCH = 32  # states sampled at once
RESIDUAL_TOLERANCE, DESCENT_STEPS = 1e-3, 40  # of the inverse kinematics of goals


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
        """Close the hands on ``objects``; states keep ``margin`` [m] to the fixtures and between bodies."""
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
