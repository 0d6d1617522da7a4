"""Perception: from frames of a camera to objects in the hands, obstacles, and a task."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.perception.boards import Board as Board
    from apex_ompl.perception.camera import Camera as Camera
    from apex_ompl.perception.camera import DepthErrors as DepthErrors
    from apex_ompl.perception.camera import look_at as look_at
    from apex_ompl.perception.frames import Frame as Frame
    from apex_ompl.perception.frames import load_frames as load_frames
    from apex_ompl.perception.frames import save_sequence as save_sequence
    from apex_ompl.perception.hand_eye import Calibration as Calibration
    from apex_ompl.perception.hand_eye import View as View
    from apex_ompl.perception.hand_eye import calibrate as calibrate

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "boards": "Board",
        "camera": "Camera DepthErrors look_at",
        "frames": "Frame load_frames save_sequence",
        "hand_eye": "Calibration View calibrate",
    },  # fmt: skip
)
