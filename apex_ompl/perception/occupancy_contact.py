"""Voxels and the robot: spheres around it, voxels that it touches, and surfaces that are measured inside of it."""

from __future__ import annotations

from collections.abc import Iterable

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cloud_contact import on_robot, signed_distances
from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.collision.solids import Solid, world_boxes
from apex_ompl.kernel.products import product
from apex_ompl.kernel.voxels import mark_near
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array, Flags
from apex_ompl.util.validation import check_array, check_number, finite_array

GAP = 5e-4  # between the robot and balls that were moved out of it [m]
STEP = 1e-4  # of differences of distances [m]
ROUNDS = 60  # of steps, of which corners between links need many


class RobotContact:
    """A robot and what it holds among the voxels of a map."""

    def __init__(self, robot: Robot) -> None:
        """Take the robot, which stays as it is."""
        self.robot, self._checker = robot, CollisionChecker(robot)

    def state(self, given: ArrayLike, name: str = "state") -> Array:
        """Return a state of the robot, shape (dof,).

        Raises:
            ParameterError: It has another shape, or is not finite.
        """
        q = finite_array(given, name)
        check_array(q, (self.robot.dof,), name)
        return q

    def cover_spheres(self, q: Array, held: Iterable[AttachedObject]) -> Array:
        """Return spheres in the world that contain robot and held objects, shape (S, 4) [m].

        Raises:
            UnknownNameError: An unknown link holds an object.
        """
        self._checker.become({}, {one.name: one for one in held}, ())
        return self._checker.kernel.cover_spheres(q)

    def own_spheres(self, q: Array, held: Iterable[AttachedObject], pose: Array, padding: float, noise: float) -> Array:
        """Return padded spheres around robot and held objects in an optical frame, shape (S, 4) [m].

        Args:
            q: State of the robot, shape (dof,).
            held: Held objects.
            pose: Pose of the optical frame, shape (4, 4) [m].
            padding: What radii are larger by [m].
            noise: What they are larger by at a depth of 1 m, and by its square at others [1/m].
        """
        spheres = self.cover_spheres(q, held)
        spheres[:, :3] = product(spheres[:, :3] - pose[:3, 3], pose[:3, :3])
        far = np.maximum(spheres[:, 2], 0.0)
        spheres[:, 3] += padding + noise * far * far
        return spheres

    def touched(
        self, q: Array, held: Iterable[AttachedObject], margin: float, among: Flags, *, origin: Array, side: float
    ) -> Flags:
        """Return the voxels that are within a margin of the robot and its held objects, shape (nx, ny, nz).

        Voxels that are up to half their diagonal farther away may be among them.

        Args:
            q: State of the robot, shape (dof,).
            held: Held objects.
            margin: The distance [m].
            among: The voxels in question, shape (nx, ny, nz).
            origin: Outer corner of the first voxel, shape (3,) [m].
            side: Side of a voxel [m].

        Raises:
            ParameterError: The margin is out of range.
        """
        kept = tuple(held)
        check_number(margin, "margin", 0.0, 0.5)
        within = margin + 0.5 * np.sqrt(3.0) * side
        spheres = self.cover_spheres(q, kept)
        spheres[:, 3] += within
        found = among & (mark_near((among.shape[0], among.shape[1], among.shape[2]), origin, side, spheres) != 0)
        cells = np.argwhere(found)
        found[tuple(cells.T)] = on_robot(origin + (cells + 0.5) * side, self.robot, q, within, kept)
        return np.asarray(found)

    def moved_out(
        self, points: Array, radius: float, states: Array, held: Iterable[AttachedObject], depth: float
    ) -> Array:
        """Return centers of balls, moved out of a robot that is known to be free in some states, shape (N, 3) [m].

        Each goes along the gradient of the distance until its ball just does not touch. Balls with their centers deeper
        inside stay where they are: there is an obstacle.

        Args:
            points: The centers, shape (N, 3) [m].
            radius: Radius of the balls [m].
            states: The states, shape (M, dof).
            held: Held objects.
            depth: How deep in the robot centers are moved from [m].
        """
        found, limit = points.copy(), radius + GAP
        placed = [solid for q in states for solid in self._solids(q, held)]
        near = np.flatnonzero(_distances(found, placed, limit) < limit)
        near = near[_distances(found[near], placed, limit) >= -depth]
        for _ in range(ROUNDS):
            gaps = _distances(found[near], placed, limit)
            near, gaps = near[gaps < radius], gaps[gaps < radius]
            if not len(near):
                break
            steps = STEP * np.eye(3)
            slopes = np.stack([
                _distances(found[near] + step, placed, limit) - _distances(found[near] - step, placed, limit)
                for step in steps
            ], axis=1)  # fmt: skip
            lengths = np.maximum(np.linalg.norm(slopes, axis=1), 1e-12)
            found[near] += ((limit - gaps) / lengths)[:, None] * slopes
        return found

    def _solids(self, q: Array, held: Iterable[AttachedObject]) -> list[tuple[coal.CollisionGeometry, pin.SE3]]:
        """Return the geometries of robot and held objects in a state, with their poses in the world."""
        robot = self.robot
        data = robot.model.createData()
        pin.forwardKinematics(robot.model, data, robot.to_pinocchio(q))
        solids = [
            (item.geometry, data.oMi[item.parentJoint] * item.placement) for item in robot.geometry.geometryObjects
        ]
        return solids + [(coal_geometry(one), pin.SE3(robot.link_pose(q, one.link) @ one.pose)) for one in held]


def _distances(points: Array, solids: list[tuple[coal.CollisionGeometry, pin.SE3]], limit: float) -> Array:
    """Return the signed distances of points from solids with their poses, at most ``limit``, shape (N,) [m]."""
    found = np.full(len(points), limit)
    for shape, pose in solids:
        low, high = world_boxes([Solid("", 0, pose, shape)], [pose])[0]
        near = ((points >= low - limit) & (points <= high + limit)).all(axis=1)
        local = (points[near] - pose.translation) @ pose.rotation
        found[near] = np.minimum(found[near], signed_distances(shape, local, limit))
    return found
