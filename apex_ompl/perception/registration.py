"""Errors of a camera and of the fingers, found by the robot's own surface in a depth image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.kernel.perception import POSE, Drawn, draw_triangles, register_rows
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.rendering import lens_of, resampled, undistorted
from apex_ompl.perception.surfaces import RobotSurface
from apex_ompl.types import Array
from apex_ompl.util.validation import check_positive, finite_numbers

TOLD = 0.1  # share of a variance that the image has to explain
STEP = 1e-3  # of joints, for differences [rad; synergies 0..1]
ROUNDS = (((0.06, 0.03), (0.06, 0.02)), ((0.05, 0.012), (0.05, 0.012)))
"""Gates and cutoffs of residuals [m], for each drawing of the robot."""


@dataclass(frozen=True)
class RegistrationSettings:
    """What may be wrong, and how much pixels say.

    Attributes:
        joint_spreads: Joint -> standard deviation of its true position from the reported one. By default 0.05 for the
            synergies of hands, whose soft fingers are not where they say, and all others are exact.
        floor: Standard deviation of the robot's surface at a pixel [m].
        share: Independent measurements for each patch of pixels that share their noise.
    """

    joint_spreads: Mapping[str, float] | None = None
    floor: float = 0.0005
    share: float = 1.0

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ParameterError: A number is out of its range.
        """
        check_positive(self.floor, "floor")
        check_positive(self.share, "share")
        for name, spread in finite_numbers(self.joint_spreads or {}, "joint_spreads").items():
            check_positive(spread, f"joint_spreads.{name}")


class Registration(NamedTuple):
    """A camera as the robot's surface corrects it.

    Attributes:
        pose: Pose of the optical frame in the world, shape (4, 4) [m].
        scale: Factor by which measured depths become true ones, beside that of the camera's file.
        state: State with the joints that may differ corrected, shape (dof,).
        covariance: Of turn [rad] and shift [m] of measured points in the optical frame, and of the scale, shape (7, 7).
        pixels: Number of pixels that counted, of every ``correlation``-th column and row.
        apart: Number of those whose surface is not where the robot's is expected, nor before it.
        surprise: Squared corrections of the camera in units of those that its file lets expect, chi-squared distributed
            where it stands as calibrated (the normalized innovation squared of a Kalman filter).
        freedoms: Degrees of freedom of ``surprise``: what the image tells of the pose and the scale, 0 to 7.
    """

    pose: Array
    scale: float
    state: Array
    covariance: Array
    pixels: int
    apart: int
    surprise: float = 0.0
    freedoms: int = 0


class CorrectedFrame(NamedTuple):
    """Depths of a pinhole with the corrections of a registration.

    Attributes:
        camera: The camera.
        depth: Depths, 0 where there is none, shape (height, width) [m].
        registration: The corrections.
        noise: Standard deviation of depth z is ``noise`` z^2 [1/m].
    """

    camera: Camera
    depth: Array
    registration: Registration
    noise: float


def spreads_of(surface: RobotSurface, settings: RegistrationSettings) -> dict[int, float]:
    """Return the joints that may differ from what is reported, by their index in a state, with standard deviations."""
    robot = surface.robot
    given = settings.joint_spreads
    if given is None:
        given = {str(hand.synergy): 0.05 for hand in robot.hands.values() if hand.synergy}
    return {robot.joint_names.index(name): spread for name, spread in given.items()}


def register(given: CorrectedFrame, surface: RobotSurface, settings: RegistrationSettings) -> Registration:
    """Correct the pose of a camera, the scale of its depths, and joints, by the robot's surface.

    Residuals are distances of measured points from the tangent planes of the expected surface (point to plane), with
    Tukey's weights; the errors that the camera's file expects are the prior.

    Args:
        given: Depths with the pose and the state that were reported.
        surface: The robot's surface.
        settings: The settings.
    """
    camera, measured, (pose, _, state, *_), noise = given
    joints = spreads_of(surface, settings)
    spreads = [camera.angle_spread] * 3 + [camera.position_spread] * 3 + [camera.depth.scale_spread, *joints.values()]
    prior = np.diag(1.0 / np.maximum(spreads, 1e-6) ** 2)
    stride = camera.depth.correlation
    height, width = (-(-n // stride) for n in measured.shape)
    lens = lens_of(camera) / stride
    unknowns, count, gate = np.zeros(len(spreads)), 0, 0.0
    information, found, corrected = prior, pose, state
    vertices = seen = surface.seen_from(pose, surface.poses(state))
    velocities = np.zeros((len(joints), *vertices.shape))
    for k, joint in enumerate(joints):
        moved = state.copy()
        moved[joint] += STEP
        velocities[k] = (surface.seen_from(pose, surface.poses(moved)) - vertices) / STEP
    limits = surface.robot.limits
    for number, rounds in enumerate(ROUNDS):
        if number > 0:  # pixels belong to other triangles after the correction
            seen = surface.seen_from(found, surface.poses(corrected)) / (1.0 + unknowns[6])
        depth, index = draw_triangles(seen, surface.faces, lens, height, width)
        drawn = Drawn(vertices, surface.faces, velocities, depth, index, lens, stride)
        for gate, cutoff in rounds:
            matrix, vector, count = register_rows(measured, drawn, unknowns, noise, settings.floor, gate, cutoff)
            information = prior + settings.share * matrix
            unknowns = unknowns + np.linalg.solve(information, settings.share * vector - prior @ unknowns)
        corrected = state.copy()
        corrected[list(joints)] += unknowns[POSE:]
        corrected = np.clip(corrected, np.minimum(limits.lower, state), np.maximum(limits.upper, state))
        found = pose.copy()
        found[:3, :3] = pose[:3, :3] @ pin.exp3(unknowns[:3])
        found[:3, 3] = pose[:3, 3] + pose[:3, :3] @ unknowns[3:6]
    sparse = measured[::stride, ::stride]
    apart = int(np.count_nonzero((index >= 0) & (sparse > depth + gate)))
    covariance = np.linalg.inv(information)
    surprise, freedoms = _surprise(unknowns[:POSE], np.array(spreads[:POSE]), covariance[:POSE, :POSE])
    return Registration(
        found, 1.0 + float(unknowns[6]), corrected, covariance[:POSE, :POSE], count, apart, surprise, freedoms
    )  # fmt: skip


def _surprise(found: Array, spreads: Array, covariance: Array) -> tuple[float, int]:
    """Return the squared correction in units of the expected one, and its degrees of freedom.

    Without a change, corrections have the covariance before minus that after. Directions in which the image tells less
    than ``TOLD`` of the variance do not count.

    Args:
        found: The correction, shape (7,).
        spreads: Standard deviations before, shape (7,).
        covariance: After, shape (7, 7).
    """
    scale = np.maximum(spreads, 1e-6)
    told, axes = np.linalg.eigh(np.eye(len(found)) - covariance / np.outer(scale, scale))
    kept = told > TOLD
    along = axes.T @ (found / scale)
    return float((along[kept] ** 2 / told[kept]).sum()), int(kept.sum())


def corrected(
    frame: Frame, surface: RobotSurface, settings: RegistrationSettings | None, frames: int = 1
) -> CorrectedFrame:
    """Return the depths of a frame, corrected by the robot's surface.

    Args:
        frame: The frame.
        surface: The robot's surface.
        settings: Settings, or None to leave the camera as it is.
        frames: Number of frames whose depths it has the mean of.

    Raises:
        ApexError: The frame has no position of a joint, or its camera is on a link that does not exist.
    """
    camera, state = frame.camera, frame.state(surface.robot.joint_names)
    noise = camera.depth.noise / float(np.sqrt(frames))
    depth = resampled(frame.depth, undistorted(camera)) * camera.depth.scale
    depth *= depth >= camera.depth.nearest
    spreads = [camera.angle_spread] * 3 + [camera.position_spread] * 3 + [camera.depth.scale_spread]
    reported = Registration(camera.pose_at(surface.robot, state), 1.0, state, np.diag(spreads) ** 2, 0, 0)
    given = CorrectedFrame(camera, depth, reported, noise)
    if settings is None:
        return given
    found = register(given, surface, settings)
    depth *= found.scale
    return CorrectedFrame(camera, depth, found, noise)
