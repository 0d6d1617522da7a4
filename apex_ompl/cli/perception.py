"""The commands ``apex-ompl calibrate`` and ``apex-ompl see``."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np

from apex_ompl.api import load_problem
from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.perception import Board, Camera, View, load_frames, measured_depths
from apex_ompl.perception import calibrate as calibrate_views
from apex_ompl.perception import see as see_frames
from apex_ompl.perception.drawing import picture_of, png_of
from apex_ompl.perception.hand_eye import FEWEST_VIEWS
from apex_ompl.perception.held import HeldObject
from apex_ompl.perception.obstacles import SeenObstacle
from apex_ompl.perception.sight import Sight
from apex_ompl.robot import load_robot
from apex_ompl.util.display import counted
from apex_ompl.util.files import check_writable, suffix_of, write_atomically

BOARD = "KIND:COLUMNSxROWS:SQUARE, of meters and inner corners, as charuco:9x6:0.025, or tag:SIDE"


def calibrate(parsed: argparse.Namespace) -> int:
    """Find the pose of a camera by frames of a board, and write the camera file."""
    suffix_of(parsed.out, (".yaml", ".yml"))
    check_writable(parsed.out)
    board, robot, frames = _board(parsed.board), load_robot(parsed.robot), load_frames(parsed.frames)
    given = frames[0].camera if parsed.camera is None else Camera.load(parsed.camera)
    camera = given.model_copy(update={"link": parsed.camera_link})
    views, shown = [], []
    for k, frame in enumerate(frames):
        if frame.color is None:
            raise FileFormatError(str(parsed.frames), f"frame {k}", None, "expected color images")
        _check_image(given, frame.camera, k, intrinsics=parsed.camera is None)
        pixels = board.find(frame.color)
        if pixels is not None:
            views.append(View(frame.state(robot.joint_names), pixels))
            shown.append(frame)
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
    depth = measured_depths(found, robot, board, shown, board_link=parsed.board_link)
    (found.camera if depth is None else found.camera.model_copy(update={"depth": depth})).save(parsed.out)
    spread, turn = 1e3 * found.camera.position_spread, np.rad2deg(found.camera.angle_spread)
    print(f"{parsed.out}: {len(views)} of {len(frames)} frames show the board, {found.residual:.2f} pixels off")
    print(f"  position    {_numbers(found.camera.position)} m, +- {spread:.2f} mm")
    print(f"  orientation {_numbers(found.camera.orientation)} (xyzw), +- {turn:.3f} degrees")
    for name, value in found.offsets.items():
        print(f"  {name} reads {np.rad2deg(-value):+.3f} degrees, +- {np.rad2deg(found.offset_spreads[name]):.3f}")
    if depth is None:
        print("  depth       as before: too few frames have depths of the board")
    else:
        noise = 1e3 * depth.noise
        print(f"  depth       scale {depth.scale:.4f}, +- {depth.scale_spread:.4f}, noise {noise:.2f} mm at 1 m")
    return 0


def see(parsed: argparse.Namespace) -> int:
    """Find held objects and obstacles in frames, print and draw them, and return 0, or 1 where something is missing."""
    if parsed.out is not None:
        suffix_of(parsed.out, (".png",))
        check_writable(parsed.out)
    problem = None if parsed.problem is None else load_problem(parsed.problem)
    robot = load_robot(parsed.robot if problem is None else problem.robot)
    attached, alignment = ((), None) if problem is None else (problem.attached, problem.goal.alignment)
    frames = [frame for source in parsed.frames for frame in load_frames(source)]
    found = see_frames(frames, robot, attached, alignment)
    if parsed.out is not None:
        write_atomically(parsed.out, png_of(picture_of(found)))
    if parsed.json:
        print(json.dumps(found.as_dict()))
    else:
        _print_sight(found)
    return 0 if found else 1


def _print_sight(found: Sight) -> None:
    """Print what was seen, a line each."""
    for frame, count in zip(found.frames, found.counts, strict=True):
        print(f"{frame.camera.name}: {counted(count, 'frame')} up to {frame.stamp:.3f} s")
    for one in found.task.held:
        print(f"  object    {_held_line(one)}")
    for seen in found.task.seen:
        print(f"  obstacle  {_obstacle_line(seen)}")
    for reason in found.reasons:
        print(f"  reason    {reason}")
    for reason in found.task.left_out:
        print(f"  left out  {reason}")


def _held_line(one: HeldObject) -> str:
    if one.reason:
        return f"{one.name}: not found, where its grasp has it {_numbers(one.pose[:3, 3])} m"
    face = f"face at {_numbers(one.face)} m, +- {1e3 * one.face_spread:.1f} mm"
    axis = f"axis {_numbers(one.axis)}, +- {np.rad2deg(one.axis_spread):.1f} degrees"
    return f"{one.name}: {face}, {axis}, {100.0 * one.seen:.0f} % seen"


def _obstacle_line(one: SeenObstacle) -> str:
    cut = ", cut by the image" if one.cut else ""
    size = " x ".join(f"{1e3 * value:.0f}" for value in one.size)
    return f"{one.kind} {size} mm at {_numbers(one.pose[:3, 3])} m, +- {1e3 * one.place_spread:.1f} mm{cut}"


def _check_image(camera: Camera, other: Camera, k: int, *, intrinsics: bool) -> None:
    """Check that a frame is of a camera.

    Raises:
        ParameterError: Its image is of another size, or its intrinsics are others.
    """
    if (camera.width, camera.height) != (other.width, other.height):
        size = f"{other.width} x {other.height} pixels"
        raise ParameterError(f"frame {k}", size, f"{camera.width} x {camera.height}, the size of the camera's images")
    if intrinsics and any(getattr(camera, name) != getattr(other, name) for name in ("focal", "center", "distortion")):
        raise ParameterError(f"frame {k}", "another camera", "frames of one camera, or its file as --camera")


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
