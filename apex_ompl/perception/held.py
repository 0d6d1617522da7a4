"""Held objects found by a fit of their known surfaces to depth near the hands.

Where an object should be follows from the pose of the hand and its grasp, with the spread that grasps have. The
robot's own surface corrects the camera (:mod:`apex_ompl.perception.registration`) and tells which pixels are the
robot's. The object's surface is fitted to the others (:mod:`apex_ompl.perception.held_fit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from apex_ompl.kernel.perception import Window, draw_triangles, select_points
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held_fit import HeldFit, Mixture
from apex_ompl.perception.held_pixels import NOT_THERE, Pixels, Surroundings, cells_of, window_around
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.held_shapes import Expected, held_shape
from apex_ompl.perception.registration import CorrectedFrame, corrected
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.surfaces import RobotSurface, inverse
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array

FARTHEST = 36.0  # squared error of six dimensions that a grasp exceeds three times in a million
UNKNOWN = 1e6  # information of what is known [1/unit^2]


@dataclass(frozen=True, eq=False)
class HeldObject:
    """Where a held object is, or why that is not known.

    Attributes:
        body: The object as it was expected.
        reason: Why there is no answer, as a sentence; empty where there is one. Pose and covariance are then those that
            the grasp alone gives.
        pose: Pose in the world, shape (4, 4) [m].
        covariance: Of a turn about the object's origin and a shift, both in the axes of the world, shape (6, 6)
            [rad, m].
        scale: Factors of the sizes along the axes of the object, shape (3,).
        size_spread: Standard deviation of the logarithms of the scales, shape (3,).
        seen: Share of the object's outline that was measured.
        points: Number of pixels that may be the object's.
        misfit: Mean robust squared error of its points over what noise explains; infinite without an answer.
        lever: Derivatives of its turn and shift by the remaining turn, shift and scale of the camera, the former in the
            axes of the world, the latter in those of the optical frame, shape (6, 7); zeros without an answer.
    """

    body: AttachedObject
    reason: str
    pose: Array
    covariance: Array
    scale: Array = field(default_factory=lambda: np.ones(3))
    size_spread: Array = field(default_factory=lambda: np.zeros(3))
    seen: float = 0.0
    points: int = 0
    misfit: float = np.inf
    lever: Array = field(default_factory=lambda: np.zeros((6, 7)))

    @property
    def name(self) -> str:
        """Name of the object."""
        return self.body.name

    @property
    def face(self) -> Array:
        """Center of the contact face in the world, or of the object where it has none, shape (3,) [m]."""
        return np.asarray(self.pose[:3, :3] @ self._point + self.pose[:3, 3])

    @property
    def axis(self) -> Array:
        """Outward axis of the contact face, or z where it has none, a unit vector, shape (3,)."""
        axis = self.pose[:3, :3] @ np.array(self.body.contact.axis if self.body.contact else (0.0, 0.0, 1.0), float)
        return np.asarray(axis / np.linalg.norm(axis))

    @property
    def face_covariance(self) -> Array:
        """Covariance of the center of the contact face, shape (3, 3) [m^2]."""
        rotation = self.pose[:3, :3]
        moved = np.hstack([-pin.skew(rotation @ self._point), np.eye(3)])
        grown = rotation * (self.size_spread * self._point)
        return np.asarray(moved @ self.covariance @ moved.T + grown @ grown.T)

    @property
    def face_spread(self) -> float:
        """Standard deviation of the center of the contact face, root of the sum over the axes [m]."""
        return float(np.sqrt(np.trace(self.face_covariance)))

    @property
    def axis_spread(self) -> float:
        """Standard deviation of the axis, root of the sum over both directions [rad]."""
        turn = pin.skew(self.axis)
        return float(np.sqrt(np.trace(turn @ self.covariance[:3, :3] @ turn.T)))

    @property
    def place_spread(self) -> float:
        """Largest standard deviation in any direction of the center of the contact face, or of a ball's center [m]."""
        shift = self.covariance[3:, 3:] if self.body.sphere is not None else self.face_covariance
        return float(np.sqrt(np.linalg.eigvalsh(shift)[-1]))

    @property
    def turn_spread(self) -> float:
        """Standard deviation of the axis in each direction [rad]; 0 for a ball, whose turn does not matter."""
        return 0.0 if self.body.sphere is not None else self.axis_spread / float(np.sqrt(2.0))

    @property
    def _point(self) -> Array:
        return np.array(self.body.contact.point if self.body.contact else (0.0, 0.0, 0.0)) * self.scale


class HeldObjectFinder:
    """Finds the objects that a robot holds in the frames of a camera.

    Attributes:
        robot: The robot.
        attached: The objects.
        settings: The settings.
    """

    def __init__(
        self, robot: Robot, attached: Sequence[AttachedObject], settings: HeldSettings | None = None,
        surface: RobotSurface | None = None,
    ) -> None:  # fmt: skip
        """Prepare the surfaces of robot and objects.

        Args:
            robot: The robot.
            attached: The objects.
            settings: The settings.
            surface: The robot's surface, where it is known already.

        Raises:
            ApexError: An object has a link that the robot does not have, or a shape without a surface.
        """
        self.robot, self.attached, self.settings = robot, tuple(attached), settings or HeldSettings()
        self._links = [robot.link_frame(one.link) for one in self.attached]
        self._data = robot.model.createData()
        self._robot = surface or RobotSurface(robot)
        self._shapes = [held_shape(one) for one in self.attached]

    def expected(self, state: Array) -> list[Expected]:
        """Return the objects as their grasps have them in a state, shape (dof,)."""
        s = self.settings
        spread = np.diag([*np.radians(s.grasp_turn), *s.grasp_shift]) ** 2
        found, data = [], self._data
        pin.forwardKinematics(self.robot.model, data, self.robot.to_pinocchio(state))
        for shape, frame in zip(self._shapes, self._links, strict=True):
            link = pin.updateFramePlacement(self.robot.model, data, frame).homogeneous
            found.append(Expected(shape, link @ shape.body.pose, turned(spread, link[:3, :3])))
        return found

    def by_grasp(self, frame: Frame) -> tuple[HeldObject, ...]:
        """Return the objects as their grasps have them, in the order of ``attached``.

        Raises:
            ApexError: The frame has no position of a joint.
        """
        return tuple(_without(one, "") for one in self.expected(frame.state(self.robot.joint_names)))

    def find(self, frame: Frame, frames: int = 1) -> tuple[HeldObject, ...]:
        """Return where the objects are, in the order of ``attached``.

        Args:
            frame: The frame.
            frames: Number of frames whose depths it has the mean of.

        Raises:
            ApexError: The frame has no position of a joint, or its camera is on a link that does not exist.
        """
        return self.find_in(corrected(frame, self._robot, self.settings.registration, frames))

    def find_in(self, seen: CorrectedFrame) -> tuple[HeldObject, ...]:
        """Return where the objects are in a frame that is corrected already, in the order of ``attached``."""
        return self.find_expected(seen, self.expected(seen.registration.state))

    def find_expected(self, seen: CorrectedFrame, expected: Sequence[Expected]) -> tuple[HeldObject, ...]:
        """Return where objects are in a frame that is corrected already, from what is expected of them."""
        found = seen.registration
        poses = self._robot.poses(found.state)
        thin = self._robot.seen_from(found.pose, poses)
        thick = self._robot.seen_from(found.pose, poses, self.settings.thickness)
        return tuple(self._find_one(one, seen, thin, thick) for one in expected)

    def _find_one(self, one: Expected, seen: CorrectedFrame, thin: Array, thick: Array) -> HeldObject:
        """Return where an object is.

        Args:
            one: The object as it is expected.
            seen: The frame.
            thin: Vertices of the robot in the optical frame, shape (V, 3) [m].
            thick: The same of a robot that is thicker all around.
        """
        camera, measured, registration, noise = seen
        s, lens = self.settings, lens_of(camera)
        expected = inverse(registration.pose) @ one.pose
        center, radius = expected[:3, 3], self.reach(one)
        window = window_around(center, radius, camera)
        if window is None:
            return _without(one, f"{one.name!r} is not in the image")
        if not camera.depth.nearest < center[2] < camera.depth.farthest:
            low, high = camera.depth.nearest, camera.depth.farthest
            return _without(one, f"{one.name!r} is {center[2]:.2f} m away, out of the range {low:g} to {high:g} m")
        around = self._surroundings(seen, window, thin, thick)
        robot, near_robot = around.robot, around.near_robot
        pixels = Pixels(*select_points(
            measured, robot, near_robot, window, lens, center, radius, 2.0 * noise, s.thickness
        ))  # fmt: skip
        count = len(pixels.points) * window.stride**2
        if count < s.least_points:
            return _without(one, around.nothing_seen(one.name, center[2] - radius), count)
        fit = HeldFit(one, seen, around, expected, self._prior(one, registration.pose), s)
        fits = fit.from_starts(pixels)
        best = min(each.cost for each in fits)
        if np.isfinite(best) and best > fit.largest_cost(pixels.points):
            return _without(one, f"{one.name!r}: what is seen in the hand has another shape", count)
        found = fit.mixture(*fit.refined(fits, radius)) if np.isfinite(best) else None
        if found is None:
            return _without(one, f"{one.name!r}: the fit to {count} pixels found no pose", count)
        return self._answer(fit, found, count)

    def reach(self, one: Expected) -> float:
        """Return the radius of the ball in which points may be an object's [m]."""
        s = self.settings
        return one.shape.surface.radius * (1.0 + 2.0 * s.size_spread) + 2.5 * max(s.grasp_shift)

    def _surroundings(self, seen: CorrectedFrame, window: Window, thin: Array, thick: Array) -> Surroundings:
        own = window.lens(lens_of(seen.camera))
        robot, near_robot = (
            draw_triangles(vertices, self._robot.faces, own, window.height, window.width)[0]
            for vertices in (thin, thick)
        )
        measured = np.ascontiguousarray(seen.depth[cells_of(window)])
        return Surroundings(window, own, measured, robot, near_robot, 2.0 * seen.noise, self.settings.thickness)

    def _prior(self, one: Expected, camera: Array) -> Array:
        """Return the information before, in the axes of a camera at a pose, shape (6, 6), or (9, 9) with sizes."""
        prior = np.asarray(np.linalg.inv(turned(one.covariance, camera[:3, :3].T)), float)
        spread = self.settings.size_spread
        if spread > 0.0:
            sizes = np.where(np.isin(range(3), one.shape.ties), spread**-2, UNKNOWN)
            prior = np.block([[prior, np.zeros((6, 3))], [np.zeros((3, 6)), np.diag(sizes)]])
        return prior

    def _answer(self, fit: HeldFit, found: Mixture, count: int) -> HeldObject:
        """Return the answer in the world, or why a fit to a number of pixels is none."""
        one, camera, covariance = fit.one, fit.seen.registration.pose, found.covariance
        share, missed = fit.around.measured_shares(found.best)
        if missed > share:
            return _without(one, f"{one.name!r}: {NOT_THERE}", count)
        if share < self.settings.least_seen:
            return _without(one, f"{one.name!r} is hidden: {100 * share:.0f} % of it can be seen", count)
        known = len(covariance) == 6
        size = np.zeros(3) if known else np.sqrt(np.diag(covariance)[6:][one.shape.ties])
        world, pose = turned(covariance[:6, :6], camera[:3, :3]), camera @ found.best.pose
        if _far_from(one, pose):
            return _without(one, f"{one.name!r}: what is seen is not where the hand holds it", count)
        lever = twice(camera[:3, :3]) @ found.lever[:6]
        return HeldObject(
            one.shape.body, "", pose, world, found.best.scale, size, share, count, found.misfit, lever
        )  # fmt: skip


def _far_from(one: Expected, pose: Array) -> bool:
    """Whether an object is farther from its grasp than grasps vary."""
    off = np.concatenate([pin.log3(pose[:3, :3] @ one.pose[:3, :3].T), pose[:3, 3] - one.pose[:3, 3]])
    return float(off @ np.linalg.solve(one.covariance, off)) > FARTHEST


def turned(covariance: Array, rotation: Array) -> Array:
    """Return the covariance of a turn and a shift, shape (6, 6), in axes that a rotation, shape (3, 3), turns."""
    both = twice(rotation)
    return np.asarray(both @ covariance @ both.T)


def twice(rotation: Array) -> Array:
    """Return the matrix that turns a turn and a shift alike, shape (6, 6)."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = rotation
    return both


def _without(one: Expected, reason: str, count: int = 0) -> HeldObject:
    return HeldObject(one.shape.body, reason, one.pose, one.covariance, points=count)
