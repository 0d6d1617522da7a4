"""The command ``apex-ompl calibrate``."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.perception import Board, Camera, View, load_frames
from apex_ompl.perception import calibrate as calibrate_views
from apex_ompl.perception.hand_eye import FEWEST_VIEWS
from apex_ompl.robot import load_robot
from apex_ompl.util.files import check_writable, suffix_of

BOARD = "KIND:COLUMNSxROWS:SQUARE, of meters and inner corners, as charuco:9x6:0.025, or tag:SIDE"


def calibrate(parsed: argparse.Namespace) -> int:
    """Find the pose of a camera by frames of a board, and write the camera file."""
    suffix_of(parsed.out, (".yaml", ".yml"))
    check_writable(parsed.out)
    board, robot, frames = _board(parsed.board), load_robot(parsed.robot), load_frames(parsed.frames)
    given = frames[0].camera if parsed.camera is None else Camera.load(parsed.camera)
    camera = given.model_copy(update={"link": parsed.camera_link})
    views = []
    for k, frame in enumerate(frames):
        if frame.color is None:
            raise FileFormatError(str(parsed.frames), f"frame {k}", None, "expected color images")
        pixels = board.find(frame.color)
        if pixels is not None:
            views.append(View(frame.state(robot.joint_names), pixels))
    if len(views) < FEWEST_VIEWS:
        raise ParameterError("frames", f"{len(views)} of {len(frames)} show it", f"{FEWEST_VIEWS} or more of the board")
    found = calibrate_views(
        robot,
        camera,
        board,
        views,
        board_link=parsed.board_link,
        offsets=tuple(filter(None, parsed.offsets.split(","))),
    )
    found.camera.save(parsed.out)
    spread, turn = 1e3 * found.camera.position_spread, np.rad2deg(found.camera.angle_spread)
    print(f"{parsed.out}: {len(views)} of {len(frames)} frames show the board, {found.residual:.2f} pixels off")
    print(f"  position    {_numbers(found.camera.position)} m, +- {spread:.2f} mm")
    print(f"  orientation {_numbers(found.camera.orientation)} (xyzw), +- {turn:.3f} degrees")
    for name, value in found.offsets.items():
        print(f"  {name} reads {np.rad2deg(-value):+.3f} degrees, +- {np.rad2deg(found.offset_spreads[name]):.3f}")
    return 0


def _numbers(values: Any) -> str:
    return " ".join(f"{value:.4f}" for value in values)


def _board(text: str) -> Board:
    """Return the board of an option.

    Raises:
        ApexError: It names none.
    """
    kind, *rest = text.split(":")
    try:
        if kind == "tag":
            (side,) = rest
            return Board(kind="tag", square=float(side))
        size, square = rest
        columns, rows = size.split("x")
        return Board.model_validate({"kind": kind, "columns": int(columns), "rows": int(rows), "square": float(square)})
    except ValueError as error:
        raise ParameterError("--board", text, BOARD) from error
