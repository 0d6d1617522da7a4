"""Held objects found by a fit of their known surfaces to depth near the hands.

Where an object should be follows from the pose of the hand and its grasp, with the spread that grasps have. The
robot's own surface corrects the camera (:mod:`apex_ompl.perception.registration`) and tells which pixels are the
robot's. The object's surface is fitted to the others (:mod:`apex_ompl.kernel.perception`), from several starts. The
covariance holds the noise, the spread of grasps, the camera's remaining error, and other minima of nearly the same
cost.
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

INFLATION = {
    "box": (1.50, 0.58), "cylinder": (1.05, 0.56), "capsule": (1.05, 0.56), "slender": (1.10, 0.52),
    "sphere": (1.02, 0.64), "mesh": (1.40, 0.68), "thin mesh": (1.06, 0.64),
}  # fmt: skip
"""Factors of the variances of measurements by shape: of one frame, and of means of frames, without flying pixels.

They make mean normalized squared errors those of chi-squared on scenes of their own (``python -m
benchmarks.perception.held --calibrate``, which prints those to take).
"""
SLENDER = 0.3  # radius over half length of cylinders and capsules below which they are slender
THIN = 0.5  # share of the volume of its hull below which a mesh is thin
ROUND, LEAST_RING = 1e-3, 12  # of vertices on rings: share of the radius in which they agree, and their least number
MISFIT, GROWTH = 1.0, 1.5  # mean squared error of points over that of noise above which variances grow, and its power
SAME = 0.02  # difference from the measured depth within which a surface was measured [m]
FARTHER = 0.04  # by which a depth lies behind a surface that is not there [m]
NOT_THERE = "no surface is seen where the hand holds it"
ALONE = 0.33  # share of the contour's measurements in one frame, in which depths at edges are missing
STEPS = 4, 3  # from each start, and in a round of what was found from there
ROUNDS = 3  # at most
SETTLED = 0.3  # squared change in a round, in units of its covariance, below which a fit has settled
TUKEY = 3.3  # standard deviations of a point from which it does not count in the end
LAST = 0.018  # residual from which points do not count in fits from the starts [m]
SAME_FIT = 9.0, 0.1  # squared difference of fits in units of their own and of grasps' spread within which they are one
HOPELESS = 60.0, 1.3  # cost above which a fit is not refined, and its part that grows with that of the best one
MOST_FITS, UNLIKELY = 2, 20.0  # fits that are refined, and difference of costs from which the worse one is not
FIRST, REACH = 0.03, 0.02  # residuals from which points at the first step, and contours, do not count [m]
SPREAD_PIXELS = 4  # around a drawing to which its depths are extended
OUTSIDE = (-1e3, 0.0, 1e2)
"""A point of the outline that no image shows [m].

With one the contour resists where it touches what it must not cover. Otherwise steps overshoot there, as only those
pixels count that are covered already, and fits swing to and fro by several pixels.
"""
FAR_AWAY = 100.0  # depth behind everything [m]
FARTHEST = 36.0  # squared error of six dimensions that a grasp exceeds three times in a million
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
        first_points: Points that fits from the starts use at most.
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
    edge: float = 0.3
    point_share: float = 1.4
    contour_share: float = 0.15
    starts: tuple[float, ...] = (0.0, -18.0, 18.0)
    most_points: int = 450
    first_points: int = 150
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
            "first_points",
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


class _Region(NamedTuple):
    """What a fit is made from.

    Attributes:
        window: Part of the image.
        prior: Information before, shape (6, 6) or (9, 9).
        share: Independent measurements, over all points.
        pixels: Number of pixels that may be the object's.
    """

    window: Window
    prior: Array
    share: float
    pixels: int


class _Sight(NamedTuple):
    """An object in a frame.

    Attributes:
        one: The object.
        seen: The frame.
        window: Part of the image.
        lens: Lens of the window.
        expected: Pose in the optical frame that the grasp gives, shape (4, 4) [m].
        prior: Information before, shape (6, 6) or (9, 9).
    """

    one: Expected
    seen: CorrectedFrame
    window: Window
    lens: Array
    expected: Array
    prior: Array


class _Data(NamedTuple):
    """What a fit is made to.

    Attributes:
        points: Points of the object in the optical frame, shape (N, 3) [m].
        beyond: Distances of pixels from those that it may cover, shape (h, w) [pixels].
        stands_for: Number of points that each of them stands for.
    """

    points: Array
    beyond: Array
    stands_for: float = 1.0

    def at_most(self, count: int) -> _Data:
        """Return the same with this number of points at most."""
        n = len(self.points)
        kept = self.points[np.linspace(0, n - 1, min(n, count)).astype(np.int64)]
        return _Data(kept, self.beyond, n / max(1, len(kept)))


class Expected(NamedTuple):
    """An object as the grasp has it.

    Attributes:
        body: The object.
        surface: Its surface.
        ties: Unknown of the scale along each axis, shape (3,).
        symmetry: ``AXIS``, ``BALL``, or 0.
        inflation: Factors of the variances of its measurements, of one frame and of means of frames.
        pose: Its pose in the world, shape (4, 4) [m].
        covariance: Of a turn and a shift in the axes of the world, shape (6, 6).
    """

    body: AttachedObject
    surface: Surface
    ties: Indices
    symmetry: int
    inflation: tuple[float, float]
    pose: Array
    covariance: Array


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
        for one in self.attached:
            robot.link_frame(one.link)
        self._robot = surface or RobotSurface(robot)
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
        for body, surface, ties, symmetry, inflation in zip(
            self.attached, self._surfaces, self._ties, self._symmetries, self._inflations, strict=True
        ):
            link = self.robot.link_pose(state, body.link)
            covariance = turned(spread, link[:3, :3])
            found.append(Expected(body, surface, ties, symmetry, inflation, link @ body.pose, covariance))
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
            around = measured[_cells(window)]
            return _without(one, _nothing_seen(one.body.name, around, robot, center[2] - radius), count)
        prior = np.asarray(np.linalg.inv(turned(one.covariance, registration.pose[:3, :3].T)), float)
        if s.size_spread > 0.0:
            sizes = np.where(np.isin(range(3), one.ties), s.size_spread**-2, UNKNOWN)
            prior = np.block([[prior, np.zeros((6, 3))], [np.zeros((3, 6)), np.diag(sizes)]])
        sight = _Sight(one, seen, window, own, expected, prior)
        data = _Data(points, beyond)
        fits = [self._fit(sight, data.at_most(s.first_points), start, STEPS[0])
                for start in self._starts(one, expected, registration)]  # fmt: skip
        best = min(fit.cost for fit in fits)
        if not np.isfinite(best):
            return _without(one, f"{one.body.name!r}: the fit to {count} pixels found no pose", count)
        outliers = 0.5 / 3.0 * (LAST / (noise * center[2] ** 2 + s.floor)) ** 2  # half of the points, by Tukey's loss
        if best > max(s.most_misfit, outliers) * self._share(sight, points):
            return _without(one, f"{one.body.name!r}: what is seen in the hand has another shape", count)
        around = np.ascontiguousarray(measured[_cells(window)])
        local = Window(0, 0, window.width, window.height, 1)
        last = TUKEY * float(np.hypot(noise * center[2] ** 2, s.floor))
        distinct = _different(fits, prior)[:MOST_FITS]
        every, wide = list[_Data](), list[SurfaceFit]()
        for fit in distinct:
            passable = _blocked(fit, (around, robot, near_robot), 2.0 * noise, s.thickness)
            every.append(_Data(*select_points(
                *passable, local, own, distinct[0].position, radius, 2.0 * noise, s.thickness
            )))  # fmt: skip
            wide.append(self._settled(sight, every[-1].at_most(s.first_points), fit, LAST))
        least = min(fit.cost for fit in wide)
        refined = [
            self._settled(sight, mine.at_most(s.most_points), fit, last)
            for fit, mine in zip(wide, every, strict=True) if fit.cost <= least + UNLIKELY
        ]  # fmt: skip
        points = every[0].points
        region = _Region(window, prior, self._share(sight, points), count)
        return self._answer(one, refined, seen, region)

    def _settled(self, sight: _Sight, data: _Data, fit: SurfaceFit, cutoff: float) -> SurfaceFit:
        """Return a fit that goes on from another until it changes by little."""
        for _ in range(ROUNDS):
            before = fit
            fit = self._fit(sight, data, _pose_of(fit), STEPS[1], cutoff)
            if _distance(fit, before, before.information) < SETTLED:
                break
        return fit

    def _fit(
        self, sight: _Sight, data: _Data, start: Array, steps: int, cutoff: float | None = None
    ) -> SurfaceFit:  # fmt: skip
        """Return a fit to points and an outline.

        Args:
            sight: What is fitted.
            data: What it is fitted to.
            start: Pose to start from in the optical frame, shape (4, 4) [m].
            steps: Number of steps.
            cutoff: Residual from which points do not count [m]; by default one that becomes narrower.
        """
        one, s = sight.one, self.settings
        alone = sight.seen.noise == sight.seen.camera.depth.noise
        inflation = one.inflation[0 if alone else 1]
        settings = FitSettings(
            noise=sight.seen.noise, floor=s.floor, edge=s.edge,
            point_share=data.stands_for * self._share(sight, data.points) / max(1, len(data.points)),
            contour_share=s.contour_share * (ALONE if alone else 1.0) * sight.window.stride / inflation,
            first=cutoff or FIRST, last=cutoff or LAST, reach=REACH, steps=steps,
        )  # fmt: skip
        return fit_surface(
            np.vstack([data.points, OUTSIDE]), data.beyond, sight.lens, one.surface.vertices, one.surface.faces,
            one.ties, one.symmetry, start, sight.expected, sight.prior, settings, len(data.points),
        )  # fmt: skip

    def _share(self, sight: _Sight, points: Array) -> float:
        """Return the number of independent measurements of points, as pixels share their noise in patches."""
        patch = (sight.seen.camera.depth.correlation / sight.window.stride) ** 2
        inflation = sight.one.inflation[0 if sight.seen.noise == sight.seen.camera.depth.noise else 1]
        return self.settings.point_share * len(points) / max(1.0, patch) / inflation

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
        self, one: Expected, fits: list[SurfaceFit], seen: CorrectedFrame, region: _Region
    ) -> HeldObject:  # fmt: skip
        registration, prior, count = seen.registration, region.prior, region.pixels
        best = min(fits, key=lambda fit: fit.cost)
        if not np.isfinite(best.cost):
            return _without(one, f"{one.body.name!r}: the fit to {count} pixels found no pose", count)
        misfit = best.cost / max(region.share, 1e-9)
        factor = max(1.0, misfit / MISFIT) ** GROWTH  # of the variances of measurements
        n = len(best.information)
        covariance: Array = np.zeros((n, n))
        common: Array = np.zeros((n, 7))
        weights = np.exp(-0.5 * np.array([fit.cost - best.cost for fit in fits]))
        for fit, weight in zip(fits, weights / weights.sum(), strict=True):
            if weight < 1e-3:
                continue
            own = np.linalg.inv(prior + (fit.information - prior) / factor)
            lever = own @ fit.cross / factor
            common = common + weight * lever
            away = np.zeros(n)
            away[:3] = pin.log3(fit.rotation @ best.rotation.T)
            away[3:6] = fit.position - best.position
            covariance = covariance + weight * (own + lever @ registration.covariance @ lever.T + np.outer(away, away))
        pose = _pose_of(best)
        share, missed = _measured_shares(best, seen.depth[_cells(region.window)])
        if missed > share:
            return _without(one, f"{one.body.name!r}: {NOT_THERE}", count)
        if share < self.settings.least_seen:
            return _without(one, f"{one.body.name!r} is hidden: {100 * share:.0f} % of it can be seen", count)
        size = np.sqrt(np.diag(covariance)[6:][one.ties]) if n > 6 else np.zeros(3)
        world, found = turned(covariance[:6, :6], registration.pose[:3, :3]), registration.pose @ pose
        if _far_from(one, found):
            return _without(one, f"{one.body.name!r}: what is seen is not where the hand holds it", count)
        lever = np.kron(np.eye(2), registration.pose[:3, :3]) @ common[:6]
        return HeldObject(one.body, "", found, world, best.scale, size, share, count, misfit, lever)


def _pose_of(fit: SurfaceFit) -> Array:
    """Return the pose of a fit in the optical frame, shape (4, 4) [m]."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = fit.rotation, fit.position
    return pose


def _different(fits: Sequence[SurfaceFit], prior: Array) -> list[SurfaceFit]:
    """Return the fits that are not the same as a better one, nor much worse than the best, the best first."""
    found: list[SurfaceFit] = []
    for fit in sorted(fits, key=lambda one: one.cost):
        if not np.isfinite(fit.cost) or (found and fit.cost > HOPELESS[0] + HOPELESS[1] * found[0].cost):
            break
        if not any(_same(fit, other, prior[:6, :6]) for other in found):
            found.append(fit)
    return found


def _same(fit: SurfaceFit, other: SurfaceFit, prior: Array) -> bool:
    """Whether two fits differ by little of what was measured, or of what grasps vary by."""
    told = _distance(fit, other, other.information[:6, :6] - prior)
    return told < SAME_FIT[0] or _distance(fit, other, prior) < SAME_FIT[1]


def _distance(fit: SurfaceFit, other: SurfaceFit, information: Array) -> float:
    """Return the squared difference of the poses of two fits by an information matrix."""
    off = np.concatenate([pin.log3(fit.rotation @ other.rotation.T), fit.position - other.position])
    return float(off @ information[:6, :6] @ off)


def _blocked(
    fit: SurfaceFit, depths: tuple[Array, Array, Array], noise: float, slack: float
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return depths of which those that an object would hide, and so cannot cover, are far away and no robot's.

    Args:
        fit: Where the object is.
        depths: Measured depths in the window, and those expected of the robot and of a thicker one, infinite where
            there is none, shape (h, w) each [m].
        noise: Largest error of depth z over z^2 [1/m].
        slack: Difference of depths that may be an error beside it [m].
    """
    measured, robot, near_robot = depths
    allowed = slack + noise * measured**2
    own = ((measured > near_robot - allowed) & (measured < robot + allowed)) | (np.abs(measured - near_robot) < allowed)
    if not own.any():
        return depths
    depth = np.where(fit.triangle >= 0, fit.depth, np.inf)
    for _ in range(SPREAD_PIXELS):
        wider = np.full((depth.shape[0] + 2, depth.shape[1] + 2), np.inf)
        wider[1:-1, 1:-1] = depth
        around = np.minimum(
            np.minimum(wider[:-2, 1:-1], wider[2:, 1:-1]), np.minimum(wider[1:-1, :-2], wider[1:-1, 2:])
        )
        depth = np.where(np.isfinite(depth), depth, around)
    blocked = own & (measured > depth + allowed)
    return (
        np.where(blocked, FAR_AWAY, measured), np.where(blocked, np.inf, robot), np.where(blocked, np.inf, near_robot)
    )  # fmt: skip


def _far_from(one: Expected, pose: Array) -> bool:
    """Whether an object is farther from its grasp than grasps vary."""
    off = np.concatenate([pin.log3(pose[:3, :3] @ one.pose[:3, :3].T), pose[:3, 3] - one.pose[:3, 3]])
    return float(off @ np.linalg.solve(one.covariance, off)) > FARTHEST


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


def _measured_shares(fit: SurfaceFit, around: Array) -> tuple[float, float]:
    """Return the shares of the drawn object at whose pixels its surface was measured, and where it was seen through."""
    there = fit.triangle >= 0
    depth = around[there]
    if not depth.size:
        return 0.0, 0.0
    farther = depth - fit.depth[there]
    return float((np.abs(farther) < SAME).mean()), float((farther > FARTHER).mean())


def _cells(window: Window) -> tuple[slice, slice]:
    """Return the rows and columns of a window."""
    height, width = window.height * window.stride, window.width * window.stride
    return (
        slice(window.top, window.top + height, window.stride), slice(window.left, window.left + width, window.stride)
    )  # fmt: skip


def _nothing_seen(name: str, depth: Array, robot: Array, front: float) -> str:
    """Return why there are no points of an object, as a sentence.

    Args:
        name: Its name.
        depth: Depths around it [m].
        robot: Expected depths of the robot there [m].
        front: Depth where it begins [m].
    """
    if np.mean(depth > 0.0) < 0.3:
        return f"{name!r}: {100 * np.mean(depth == 0.0):.0f} % of the image around it have no depth"
    if np.mean(depth[depth > 0.0] < front) > 0.3 or np.mean(np.isfinite(robot)) > 0.5:
        return f"{name!r} is hidden: the camera sees other surfaces before it"
    return f"{name!r}: {NOT_THERE}"


def _without(one: Expected, reason: str, count: int = 0) -> HeldObject:
    return HeldObject(one.body, reason, one.pose, one.covariance, points=count)


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
    for round_body in (body.cylinder, body.capsule):
        if round_body is not None and round_body.radius < SLENDER * round_body.length / 2.0:
            return "slender"
    if body.shape in INFLATION and body.mesh is None:
        return body.shape
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    return "thin mesh" if abs(mesh.volume) < THIN * mesh.convex_hull.volume else "mesh"
