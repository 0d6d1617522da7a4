"""Held objects found by a fit of their known surfaces to depth near the hands.

Where an object should be follows from the pose of the hand and its grasp, with the spread that grasps have. The
robot's own surface corrects the camera (:mod:`apex_ompl.perception.registration`) and tells which pixels are the
robot's. The object's surface is fitted to the others (:mod:`apex_ompl.kernel.perception`), from several starts. The
covariance holds the noise, the spread of grasps, the camera's remaining error, and other minima of nearly the same cost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import trimesh

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.perception import (
    AXIS,
    BALL,
    FitSettings,
    SurfaceFit,
    Window,
    draw_triangles,
    fit_surface,
    select_points,
)
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.registration import CorrectedFrame, Registration, RegistrationSettings, corrected
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.surfaces import RobotSurface, Surface, body_surface, inverse
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array, Indices
from apex_ompl.util.validation import check_number, check_positive

INFLATION = {"box": 1.4, "cylinder": 1.1, "capsule": 1.1, "sphere": 1.0, "mesh": 1.6, "thin mesh": 1.1}
"""Factors of the variances of measurements by shape, and of means of frames, which leave out what flies between surfaces.

They make mean normalized squared errors those of chi-squared on scenes of their own (``python -m
benchmarks.perception.held --calibrate``).
"""
AVERAGED = 0.75
THIN = 0.5  # share of the volume of its hull below which a mesh is thin
ROUND, LEAST_RING = 1e-3, 12  # of vertices on rings: share of the radius in which they agree, and their least number
MISFIT = 2.5  # mean squared error of points over that of noise above which covariances grow
SAME = 0.02  # difference from the measured depth within which a surface was measured [m]
FARTHER = 0.04  # by which a depth lies behind a surface that is not there [m]
UNKNOWN = 1e6  # information of what is known [1/unit^2]


@dataclass(frozen=True)
class HeldSettings:
    """What is expected of grasps and sizes, and how much measurements say.

    Attributes:
        grasp_shift: Standard deviations of an object's place along the axes of the link that holds it [m].
        grasp_turn: Standard deviations of its orientation about them [degrees].
        size_spread: Standard deviation of the logarithms of its sizes; 0 where they are known.
        registration: Settings of the correction of the camera, or None to leave the camera as it is.
        thickness: Distance from the robot's surface within which points may be its own [m].
        floor: Standard deviation of the object's surface at a point [m].
        edge: Standard deviation of the contour [pixels].
        point_share: Independent measurements for each patch of pixels that share their noise.
        contour_share: Independent measurements for each pixel of the contour.
        starts: Turns about the axis of the grasp that varies most, from which fits start [degrees].
        most_points: Points that are used at most.
        least_points: Pixels without which there is no answer.
        least_seen: Share of the expected outline without which there is no answer.
        most_misfit: Mean squared error of points over that of noise above which there is no answer.
    """

    grasp_shift: tuple[float, float, float] = (0.008, 0.008, 0.003)
    grasp_turn: tuple[float, float, float] = (4.0, 4.0, 10.0)
    size_spread: float = 0.0
    registration: RegistrationSettings | None = field(default_factory=RegistrationSettings)
    thickness: float = 0.005
    floor: float = 0.0005
    edge: float = 0.4
    point_share: float = 1.4
    contour_share: float = 0.15
    starts: tuple[float, ...] = (0.0, -18.0, 18.0)
    most_points: int = 300
    least_points: int = 60
    least_seen: float = 0.2
    most_misfit: float = 10.0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        for name in ("grasp_shift", "grasp_turn"):
            for value in getattr(self, name):
                check_positive(value, name)
        for name in (
            "thickness",
            "floor",
            "edge",
            "point_share",
            "contour_share",
            "most_points",
            "least_points",
            "most_misfit",
        ):
            check_positive(getattr(self, name), name)
        check_number(self.size_spread, "size_spread", 0.0, 1.0)
        check_number(self.least_seen, "least_seen", 0.0, 1.0)
        if not self.starts:
            raise ParameterError("starts", self.starts, "one angle or more")


@dataclass(frozen=True, eq=False)
class HeldObject:
    """Where a held object is, or why that is not known.

    Attributes:
        name: Name of the object.
        reason: Why there is no answer, as a sentence; empty where there is one. Pose and covariance are then those that
            the grasp alone gives.
        pose: Pose in the world, shape (4, 4) [m].
        scale: Factors of the sizes along the axes of the object, shape (3,).
        covariance: Of a turn about the object's origin and a shift, both in the axes of the world, [rad, m], shape (6, 6).
        size_spread: Standard deviation of the logarithms of the scales, shape (3,).
        face: Center of the contact face in the world, shape (3,) [m].
        axis: Its outward axis, a unit vector, shape (3,).
        face_spread: Standard deviation of the face's center, root of the sum over the axes [m].
        axis_spread: Standard deviation of the axis, root of the sum over both directions [rad].
        seen: Share of the object's outline that was measured.
        points: Number of pixels that may be the object's.
        misfit: Mean robust squared error of its points over what noise explains; infinite without an answer.
    """

    name: str
    reason: str
    pose: Array
    scale: Array
    covariance: Array
    size_spread: Array
    face: Array
    axis: Array
    face_spread: float
    axis_spread: float
    seen: float
    points: int
    misfit: float


class Expected(NamedTuple):
    """An object as the grasp has it.

    Attributes:
        body: The object.
        surface: Its surface.
        ties: Unknown of the scale along each axis, shape (3,).
        symmetry: ``AXIS``, ``BALL``, or 0.
        inflation: Factor of the variances of its measurements.
        pose: Its pose in the world, shape (4, 4) [m].
        covariance: Of a turn and a shift in the axes of the world, shape (6, 6).
    """

    body: AttachedObject
    surface: Surface
    ties: Indices
    symmetry: int
    inflation: float
    pose: Array
    covariance: Array


class HeldObjectFinder:
    """Finds the objects that a robot holds in the frames of a camera.

    Attributes:
        robot: The robot.
        attached: The objects.
        settings: The settings.
    """

    def __init__(self, robot: Robot, attached: Sequence[AttachedObject], settings: HeldSettings | None = None) -> None:
        """Prepare the surfaces of robot and objects.

        Raises:
            ApexError: An object has a link that the robot does not have, or a shape without a surface.
        """
        self.robot, self.attached, self.settings = robot, tuple(attached), settings or HeldSettings()
        for one in self.attached:
            robot.link_frame(one.link)
        self._robot = RobotSurface(robot)
        self._surfaces = [body_surface(one) for one in self.attached]
        self._ties = [_ties(one, surface) for one, surface in zip(self.attached, self._surfaces, strict=True)]
        pairs = list(zip(self.attached, self._surfaces, strict=True))
        self._symmetries = [_symmetry(one, surface) for one, surface in pairs]
        self._inflations = [INFLATION[_shape_of(one, surface)] for one, surface in pairs]

    def expected(self, state: Array) -> list[Expected]:
        """Return the objects as their grasps have them in a state, shape (dof,)."""
        s = self.settings
        spread = np.diag([*np.radians(s.grasp_turn), *s.grasp_shift]) ** 2
        found = []
        for body, *about in zip(
            self.attached, self._surfaces, self._ties, self._symmetries, self._inflations, strict=True
        ):
            link = self.robot.link_pose(state, body.link)
            found.append(Expected(body, *about, link @ body.pose, turned(spread, link[:3, :3])))
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
        found = seen.registration
        poses = self._robot.poses(found.state)
        thin = self._robot.seen_from(found.pose, poses)
        thick = self._robot.seen_from(found.pose, poses, self.settings.thickness)
        return tuple(self._find_one(one, seen, thin, thick) for one in self.expected(found.state))

    def _find_one(
        self, one: Expected, seen: CorrectedFrame, thin: Array, thick: Array
    ) -> HeldObject:  # fmt: skip
        camera, measured, registration, noise = seen
        s, lens = self.settings, lens_of(camera)
        expected = inverse(registration.pose) @ one.pose
        center = expected[:3, 3]
        shift = 2.5 * max(s.grasp_shift)
        radius = one.surface.radius * (1.0 + 2.0 * s.size_spread) + shift
        window = window_around(center, radius, camera)
        if window is None:
            return _without(one, f"{one.body.name!r} is not in the image")
        if not camera.depth.nearest < center[2] < camera.depth.farthest:
            low, high = camera.depth.nearest, camera.depth.farthest
            return _without(one, f"{one.body.name!r} is {center[2]:.2f} m away, out of the range {low:g} to {high:g} m")
        own = window.lens(lens)
        robot, near_robot = (
            draw_triangles(vertices, self._robot.faces, own, window.height, window.width)[0]
            for vertices in (thin, thick)
        )
        points, beyond = select_points(
            measured, robot, near_robot, window, lens, center, radius, 2.0 * noise, s.thickness
        )
        count = len(points) * window.stride**2
        if count < s.least_points:
            return _without(one, _nothing_seen(one, measured, window, robot, center, radius), count)
        kept = points[np.linspace(0, len(points) - 1, min(len(points), s.most_points)).astype(np.int64)]
        settings = self._fit_settings(one, seen, window, len(points) / len(kept))
        prior = np.linalg.inv(turned(one.covariance, registration.pose[:3, :3].T))
        if s.size_spread > 0.0:
            sizes = np.where(np.isin(range(3), one.ties), s.size_spread**-2, UNKNOWN)
            prior = np.block([[prior, np.zeros((6, 3))], [np.zeros((3, 6)), np.diag(sizes)]])
        fits = [
            fit_surface(kept, beyond, own, one.surface.vertices, one.surface.faces, one.ties, one.symmetry, start, expected, prior,
                        settings)
            for start in self._starts(one, expected, registration)
        ]  # fmt: skip
        misfit = min(fit.cost for fit in fits) / (settings.point_share * len(kept))
        return self._answer(one, fits, prior, misfit, measured, window, registration, count)

    def _fit_settings(self, one: Expected, seen: CorrectedFrame, window: Window, thinning: float) -> FitSettings:
        """Return the weights of points that stand for others, of pixels that share their noise in patches."""
        s = self.settings
        patch = (seen.camera.depth.correlation / window.stride) ** 2
        inflation = one.inflation * (1.0 if seen.noise == seen.camera.depth.noise else AVERAGED)
        return FitSettings(
            noise=seen.noise, floor=s.floor, edge=s.edge,
            point_share=s.point_share * thinning / max(1.0, patch) / inflation,
            contour_share=s.contour_share * window.stride / inflation, first=0.03, last=0.018, reach=0.02, steps=8,
        )  # fmt: skip

    def _starts(self, one: Expected, expected: Array, registration: Registration) -> list[Array]:
        """Return the poses to start from, in the optical frame: turned about the axis about which grasps vary most."""
        values, vectors = np.linalg.eigh(one.covariance[:3, :3])
        axis = registration.pose[:3, :3].T @ vectors[:, int(np.argmax(values))]
        starts = []
        for degrees in self.settings.starts:
            start = expected.copy()
            start[:3, :3] = pin.exp3(np.radians(degrees) * axis) @ expected[:3, :3]
            starts.append(start)
        return starts

    def _answer(
        self, one: Expected, fits: list[SurfaceFit], prior: Array, misfit: float, measured: Array, window: Window,
        registration: Registration, count: int,
    ) -> HeldObject:  # fmt: skip
        best = min(fits, key=lambda fit: fit.cost)
        if not np.isfinite(best.cost):
            return _without(one, f"{one.body.name!r}: the fit to {count} pixels found no pose", count)
        if misfit > self.settings.most_misfit:
            return _without(one, f"{one.body.name!r}: what is seen in the hand has another shape", count)
        factor = max(1.0, misfit / MISFIT) ** 2  # of the variances of measurements
        covariance, n = np.zeros_like(best.information), len(best.information)
        weights = np.exp(-0.5 * np.array([fit.cost - best.cost for fit in fits]))
        for fit, weight in zip(fits, weights / weights.sum(), strict=True):
            if weight < 1e-3:
                continue
            own = np.linalg.inv(prior + (fit.information - prior) / factor)
            lever = own @ fit.cross / factor
            away = np.zeros(n)
            away[:3] = pin.log3(fit.rotation @ best.rotation.T)
            away[3:6] = fit.position - best.position
            covariance += weight * (own + lever @ registration.covariance @ lever.T + np.outer(away, away))
        pose, scale = np.eye(4), best.scale
        pose[:3, :3], pose[:3, 3] = best.rotation, best.position
        seen, missed = _measured_shares(best, measured, window)
        if missed > seen:
            return _without(one, f"{one.body.name!r}: no surface is seen where the hand holds it", count)
        if seen < self.settings.least_seen:
            return _without(one, f"{one.body.name!r} is hidden: {100 * seen:.0f} % of it can be seen", count)
        world = turned(covariance[:6, :6], registration.pose[:3, :3])
        size = np.sqrt(np.diag(covariance)[6:][one.ties]) if n > 6 else np.zeros(3)
        return _described(one.body, "", registration.pose @ pose, scale, world, size, seen, count, misfit)


def turned(covariance: Array, rotation: Array) -> Array:
    """Return the covariance of a turn and a shift, shape (6, 6), in axes that a rotation, shape (3, 3), turns."""
    both = np.kron(np.eye(2), rotation)
    return np.asarray(both @ covariance @ both.T)


def window_around(center: Array, radius: float, camera: Camera) -> Window | None:
    """Return the part of the image around a ball in the optical frame, of every second pixel where it is large.

    None where less than 12 pixels of it are in the image.
    """
    if center[2] < 2.0 * radius:
        return None
    lens = lens_of(camera)
    column, row = lens[:2] * center[:2] / center[2] + lens[2:]
    reach = radius / center[2] * lens[:2] * 1.1 + 2.0
    left, top = max(0, int(column - reach[0])), max(0, int(row - reach[1]))
    right, bottom = min(camera.width, int(column + reach[0]) + 1), min(camera.height, int(row + reach[1]) + 1)
    if right - left < 12 or bottom - top < 12:
        return None
    stride = 1 if max(right - left, bottom - top) <= 128 else 2
    return Window(left, top, (right - left) // stride, (bottom - top) // stride, stride)


def _measured_shares(fit: SurfaceFit, measured: Array, window: Window) -> tuple[float, float]:
    """Return the shares of the drawn object at whose pixels its surface was measured, and where it was seen through."""
    there = fit.index >= 0
    rows = window.top + window.stride * np.arange(window.height)
    columns = window.left + window.stride * np.arange(window.width)
    depth = measured[np.ix_(rows, columns)][there]
    if not depth.size:
        return 0.0, 0.0
    farther = depth - fit.depth[there]
    return float((np.abs(farther) < SAME).mean()), float((farther > FARTHER).mean())


def _nothing_seen(
    one: Expected, measured: Array, window: Window, robot: Array, center: Array, radius: float
) -> str:  # fmt: skip
    """Return why there are no points of an object, as a sentence."""
    part = measured[
        window.top : window.top + window.height * window.stride,
        window.left : window.left + window.width * window.stride,
    ]
    name = repr(one.body.name)
    if np.mean(part > 0.0) < 0.3:
        return f"{name}: {100 * np.mean(part == 0.0):.0f} % of the image around it have no depth"
    if np.mean(part[part > 0.0] < center[2] - radius) > 0.3 or np.mean(np.isfinite(robot)) > 0.5:
        return f"{name} is hidden: the camera sees other surfaces before it"
    return f"{name}: no surface is seen where the hand holds it"


def _without(one: Expected, reason: str, count: int = 0) -> HeldObject:
    return _described(one.body, reason, one.pose, np.ones(3), one.covariance, np.zeros(3), 0.0, count, np.inf)


def _described(
    body: AttachedObject, reason: str, pose: Array, scale: Array, covariance: Array, size_spread: Array, seen: float,
    points: int, misfit: float,
) -> HeldObject:  # fmt: skip
    """Return the answer with its contact face."""
    contact = body.contact
    point = np.array(contact.point if contact else (0.0, 0.0, 0.0)) * scale
    direction = np.array(contact.axis if contact else (0.0, 0.0, 1.0), float)
    arm, axis = pose[:3, :3] @ point, pose[:3, :3] @ (direction / np.linalg.norm(direction))
    to_face = np.hstack([-pin.skew(arm), np.eye(3)])
    face = to_face @ covariance @ to_face.T
    face += np.diag((pose[:3, :3] ** 2) @ (size_spread * point) ** 2)
    turn = pin.skew(axis)
    return HeldObject(
        body.name, reason, pose, scale, covariance, size_spread, pose[:3, 3] + arm, axis,
        float(np.sqrt(np.trace(face))), float(np.sqrt(np.trace(turn @ covariance[:3, :3] @ turn.T))), seen, points, misfit,
    )  # fmt: skip


def _ties(body: AttachedObject, surface: Surface) -> Indices:
    """Return which axes have the same scale: those of round surfaces, and of meshes that are as wide as deep."""
    if body.sphere is not None:
        return np.array([0, 0, 0])
    if body.box is not None:
        return np.array([0, 1, 2])
    sides = np.ptp(surface.vertices, axis=0)
    return np.array([0, 0, 2]) if abs(sides[0] - sides[1]) < 1e-3 * sides[0] else np.array([0, 1, 2])


def _symmetry(body: AttachedObject, surface: Surface) -> int:
    """Return ``AXIS`` for a body of revolution about its z, whose vertices lie on rings, ``BALL`` or 0."""
    if body.sphere is not None:
        return BALL
    if body.box is not None:
        return 0
    radii = np.hypot(surface.vertices[:, 0], surface.vertices[:, 1])
    rings = np.round(np.stack([radii, surface.vertices[:, 2]], axis=1) / (ROUND * surface.radius))
    _, owner, count = np.unique(rings, axis=0, return_inverse=True, return_counts=True)
    small = radii < ROUND * surface.radius
    return AXIS if (small | (count[owner.ravel()] >= LEAST_RING)).all() else 0


def _shape_of(body: AttachedObject, surface: Surface) -> str:
    """Return the key of a body in ``INFLATION``."""
    if body.shape in INFLATION and body.mesh is None:
        return body.shape
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    return "thin mesh" if abs(mesh.volume) < THIN * mesh.convex_hull.volume else "mesh"
