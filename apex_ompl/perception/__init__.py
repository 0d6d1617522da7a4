"""Perception: from frames of a camera to objects in the hands, obstacles, and a task."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.perception.alignment import AlignSettings as AlignSettings
    from apex_ompl.perception.alignment import SeenTask as SeenTask
    from apex_ompl.perception.alignment import vect_align as vect_align
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
    from apex_ompl.perception.held import HeldObject as HeldObject
    from apex_ompl.perception.held import HeldObjectFinder as HeldObjectFinder
    from apex_ompl.perception.held import HeldSettings as HeldSettings
    from apex_ompl.perception.obstacles import ObstacleFinder as ObstacleFinder
    from apex_ompl.perception.obstacles import ObstacleSettings as ObstacleSettings
    from apex_ompl.perception.obstacles import SeenObstacle as SeenObstacle

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "alignment": "AlignSettings SeenTask vect_align",
        "boards": "Board",
        "camera": "Camera DepthErrors look_at",
        "frames": "Frame load_frames save_sequence",
        "hand_eye": "Calibration View calibrate",
        "held": "HeldObject HeldObjectFinder HeldSettings",
        "obstacles": "ObstacleFinder ObstacleSettings SeenObstacle",
    },  # fmt: skip
)
