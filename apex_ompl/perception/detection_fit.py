"""Detected objects, refined by a fit of their surfaces to depth.

The fit is that of held objects (:mod:`apex_ompl.perception.held`): a detection takes the place of the grasp. What
shows a support, such as a table, is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.perception import Window, draw_triangles
from apex_ompl.perception.detector import KINDS, KNOWN_TURN, OPEN, DetectedObject
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.held import HeldObject, HeldObjectFinder
from apex_ompl.perception.held_pixels import window_around
from apex_ompl.perception.held_settings import HeldSettings
from apex_ompl.perception.held_shapes import Expected
from apex_ompl.perception.registration import CorrectedFrame, corrected
from apex_ompl.perception.rendering import lens_of
from apex_ompl.perception.surfaces import RobotSurface, body_surface, inverse
from apex_ompl.robot.compose import WORLD
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject, Body
from apex_ompl.types import Array

PLACE_SPREAD = 0.012  # of the center of a detection; points are looked for up to 2.5 times that farther out [m]
TURNS = (0.0, 30.0, -30.0)  # from which fits start: of square bodies about the axis, of round ones tilted [degrees]
TILT = 0.05  # by which the standard deviation of the tilt along the ray is larger than that across it [rad]
STILL = 0.01  # standard deviation of turns of round bodies about their axes, while they are fitted [rad]
ROUND = ("can", "cup", "peg")
SLACK = 0.004  # distance from a support within which points are its own, beside the noise [m]
LEAST_SLOPE = 0.1  # cosine of the angle of a ray with a support's normal, from which on the distance is that
NEAR = 0.15  # distance of a detection from where an object is expected [m]
AWAY = 50.0  # depth that is put in place of a support's [m]


class DetectionFit:
    """Fits the surfaces of objects to depth, from where a detector found them.

    Attributes:
        robot: The robot, which corrects the camera and whose pixels are left out.
        supports: Solids on which objects stand, whose pixels are left out.
        settings: Settings of the fit.
    """

    def __init__(
        self, robot: Robot, bodies: Mapping[str, Body], supports: Sequence[Body] | None = None,
        settings: HeldSettings | None = None,
    ) -> None:  # fmt: skip
        """Prepare the surfaces.

        Args:
            robot: The robot.
            bodies: Kind -> a body of that kind, its center at the origin and its axis along z; poses are not used.
            supports: Solids; by default those that are fixed beside the robot.
            settings: Settings of the fit, with a ``size_spread`` where sizes differ from those of the bodies; spreads
                of grasps and starts are not used.

        Raises:
            ApexError: A kind is not known, or a body has no surface.
        """
        unknown = sorted(set(bodies) - set(KINDS))
        if unknown:
            raise ParameterError("bodies", unknown[0], f"bodies by kind, of {', '.join(KINDS)}")
        self.robot, self.supports = robot, tuple(robot.fixtures if supports is None else supports)
        self.settings = replace(settings or HeldSettings(), grasp_shift=(PLACE_SPREAD,) * 3, starts=TURNS)
        self._surface = RobotSurface(robot)
        named = [_named(kind, one) for kind, one in bodies.items()]
        self._finder = HeldObjectFinder(robot, named, self.settings, self._surface)
        self._templates = dict(zip(bodies, self._finder.expected(robot.home), strict=True))
        self._supports = [body_surface(one).at(one.pose) for one in self.supports]

    def refine(self, frame: Frame, found: Sequence[DetectedObject], frames: int = 1) -> tuple[HeldObject, ...]:
        """Return where objects are that were found in a frame, in order; those of kinds without a body are left out.

        Args:
            frame: The frame, with the positions of all joints.
            found: The objects.
            frames: Number of frames whose depths it has the mean of.

        Raises:
            ApexError: The frame has no position of a joint, or its camera is on a link that does not exist.
        """
        return self.refine_in(corrected(frame, self._surface, self.settings.registration, frames), found)

    def refine_in(self, seen: CorrectedFrame, found: Sequence[DetectedObject]) -> tuple[HeldObject, ...]:
        """Return the same for a frame that is corrected already."""
        pose = seen.registration.pose
        moved = pose @ inverse(seen.camera.pose_at(self.robot, seen.registration.state))
        chosen = [one for one in found if one.kind in self._templates]
        expected = [
            self._templates[one.kind]._replace(pose=moved @ one.pose, covariance=_spread(one, pose[:3, 3]))
            for one in chosen
        ]
        depth = seen.depth.copy()
        for item in expected:
            center = (item.pose[:3, 3] - pose[:3, 3]) @ pose[:3, :3]
            window = window_around(center, self._finder.reach(item), seen.camera)
            if window is not None:
                self._remove_supports(depth, window, seen)
        fitted = self._finder.find_expected(seen._replace(depth=depth), expected)
        return tuple(_as_detected(it, one) for it, one in zip(fitted, chosen, strict=True))

    def _remove_supports(self, depth: Array, window: Window, seen: CorrectedFrame) -> None:
        """Put what shows a support in a window of a depth image far away, so that no object covers it."""
        rows = slice(window.top, window.top + window.height * window.stride)
        columns = slice(window.left, window.left + window.width * window.stride)
        part, rays = depth[rows, columns], seen.camera.grid[rows, columns]
        lens = Window(window.left, window.top, part.shape[1], part.shape[0], 1).lens(lens_of(seen.camera))
        for surface in self._supports:
            support = surface.at(inverse(seen.registration.pose))
            drawn, index = draw_triangles(*support, lens, *part.shape)
            mine = support.face_normals()[index]
            slope = np.abs(mine[..., 0] * rays[..., 0] + mine[..., 1] * rays[..., 1] + mine[..., 2])
            allowed = SLACK / np.maximum(slope, LEAST_SLOPE) + 2.0 * seen.noise * part * part
            part[(index >= 0) & (part > 0.0) & (part > drawn - allowed)] = AWAY


def _spread(one: DetectedObject, eye: Array) -> Array:
    """Return the covariance of a detection, by which the starts of a round body are tilted along the ray."""
    if one.kind not in ROUND:
        return one.covariance
    ray, axis = one.center - eye, one.axis
    values, vectors = np.linalg.eigh(one.covariance[:3, :3])
    across = np.cross(ray, axis)
    length = float(np.linalg.norm(across))
    across = across / length if length > 1e-3 * float(np.linalg.norm(ray)) else vectors[:, 0]
    found = one.covariance.copy()
    found[:3, :3] = values[0] * (np.eye(3) - np.outer(axis, axis)) + STILL**2 * np.outer(axis, axis)
    found[:3, :3] += TILT**2 * np.outer(across, across)
    return found


def _as_detected(found: HeldObject, one: DetectedObject) -> HeldObject:
    """Return a fitted object, of a round one with an unknown turn about its axis."""
    if one.kind not in ROUND or found.reason:
        return found
    covariance = found.covariance.copy()
    covariance[:3, :3] += KNOWN_TURN**2 * np.outer(found.pose[:3, 2], found.pose[:3, 2])
    return replace(found, covariance=covariance)


def nearest(found: Sequence[DetectedObject], kind: str, one: Expected, within: float = NEAR) -> DetectedObject | None:
    """Return the detection of a kind that is nearest to where an object is expected, or None.

    Args:
        found: Detections.
        kind: The kind.
        one: The object.
        within: Largest distance of the centers [m].
    """
    away = [(float(np.linalg.norm(it.center - one.pose[:3, 3])), it) for it in found if it.kind == kind]
    best = min(away, key=lambda item: item[0], default=None)
    return best[1] if best is not None and best[0] < within else None


def with_detection(one: Expected, found: DetectedObject) -> Expected:
    """Return what is expected of a held object from its grasp and a detection, each by its covariance.

    Of kinds whose ends are the same the axis is taken the way that agrees with the grasp.
    """
    expected, axis = one.pose[:3, 2], found.axis
    if found.kind not in OPEN and axis @ expected < 0.0:
        axis = -axis
    off = np.zeros(6)
    off[3:] = found.center - one.pose[:3, 3]
    measured = np.linalg.inv(found.covariance)
    if found.kind == "ball":
        measured[:3, :3] = 0.0
    else:
        across = np.cross(expected, axis)
        sine = float(np.linalg.norm(across))
        off[:3] = across / max(sine, 1e-9) * np.arctan2(sine, expected @ axis)
    covariance = np.linalg.inv(np.linalg.inv(one.covariance) + measured)
    step = covariance @ (measured @ off)
    pose = one.pose.copy()
    pose[:3, :3] = pin.exp3(step[:3]) @ pose[:3, :3]
    pose[:3, 3] += step[3:]
    return one._replace(pose=pose, covariance=covariance)


def _named(kind: str, body: Body) -> AttachedObject:
    """Return a body with the name of its kind, that no link of the robot holds."""
    kept = {name: getattr(body, name) for name in ("box", "sphere", "cylinder", "capsule", "mesh")}
    contact = body.contact if isinstance(body, AttachedObject) else None
    return AttachedObject(name=kind, link=WORLD, contact=contact, **kept)
