"""Scale and noise of a camera's depths, by the plane of a board whose pose is known from calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.perception.boards import Board
from apex_ompl.perception.camera import DepthErrors
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.hand_eye import Calibration
from apex_ompl.robot.model import Robot
from apex_ompl.types import Array, Flags

LEAST_PIXELS, LEAST_FRAMES = 100, 4
FARTHEST_OFF = 0.1  # share by which depths of the board may be off; others are of something before it
NORMAL = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
LEAST_SPREAD = 1e-4  # of the scale
LOW, HIGH = 0.5, 2.0  # between which a scale is


def measured_depths(
    found: Calibration, robot: Robot, board: Board, frames: Sequence[Frame], *, board_link: str | None
) -> DepthErrors | None:
    """Return the camera's range and errors of depths with the scale and the noise that frames of the board show.

    In each frame the median of predicted over measured depths of the board's pixels is taken; the scale is the median
    of those of the frames. What a focal length or a size of the board is off shows here as well.

    Args:
        found: The calibration.
        robot: The robot.
        board: The board.
        frames: Frames that show the board; those without depths of it are left out.
        board_link: The link that carries the board, or None where it stands still.

    Returns:
        The errors, or None where fewer than 4 frames have depths of the board.

    Raises:
        ApexError: A frame has another size, or lacks a joint.
    """
    ratios, spreads = [], []
    for frame in frames:
        predicted, inside = _plane(found, robot, board, frame, board_link)
        with np.errstate(divide="ignore"):
            ratio = predicted / frame.depth
        kept = inside & (np.abs(ratio - 1.0) < FARTHEST_OFF)
        if kept.sum() < LEAST_PIXELS:
            continue
        ratios.append(np.median(ratio[kept]))
        spreads.append(NORMAL * np.median(np.abs(ratio[kept] / ratios[-1] - 1.0) / predicted[kept]))
    if len(ratios) < LEAST_FRAMES:
        return None
    scale = float(np.clip(np.median(ratios), LOW, HIGH))
    apart = NORMAL * float(np.median(np.abs(np.array(ratios) - scale))) / np.sqrt(len(ratios))
    changes = {"scale": scale, "scale_spread": max(apart, LEAST_SPREAD), "noise": float(np.median(spreads))}
    return found.camera.depth.model_copy(update=changes)


def _plane(found: Calibration, robot: Robot, board: Board, frame: Frame, board_link: str | None) -> tuple[Array, Flags]:
    """Return the depths of the board's plane, and whether pixels are within its corners, shape (height, width) each."""
    camera = found.camera
    if frame.depth.shape != (camera.height, camera.width):
        raise ParameterError("frames", frame.depth.shape, f"images of shape {(camera.height, camera.width)}")
    q = frame.state(robot.joint_names)
    q += [found.offsets.get(name, 0.0) for name in robot.joint_names]
    mount = np.eye(4) if board_link is None else robot.link_pose(q, board_link)
    pose = np.linalg.inv(camera.pose_at(robot, q)) @ mount @ found.board
    rays = np.concatenate([camera.grid, np.ones((*camera.grid.shape[:2], 1))], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
        flat = (rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :2]
    edge = np.abs(board.corners[:, :2]).max(axis=0)
    return depth, (np.abs(flat) < edge).all(axis=-1) & (depth > 0.0)
