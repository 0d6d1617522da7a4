"""Perception: cameras, their calibration, and frames with color and depth."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.perception.alignment import AlignSettings as AlignSettings
    from apex_ompl.perception.alignment import SeenTask as SeenTask
    from apex_ompl.perception.alignment import vect_align as vect_align
    from apex_ompl.perception.bags import bag_frames as bag_frames
    from apex_ompl.perception.boards import Board as Board
    from apex_ompl.perception.camera import Camera as Camera
    from apex_ompl.perception.camera import DepthErrors as DepthErrors
    from apex_ompl.perception.camera import look_at as look_at
    from apex_ompl.perception.depth_scale import measured_depths as measured_depths
    from apex_ompl.perception.detection_fit import DetectionFit as DetectionFit
    from apex_ompl.perception.detector import DetectedObject as DetectedObject
    from apex_ompl.perception.detector import DetectorSettings as DetectorSettings
    from apex_ompl.perception.detector import ObjectDetector as ObjectDetector
    from apex_ompl.perception.frames import Frame as Frame
    from apex_ompl.perception.frames import load_frames as load_frames
    from apex_ompl.perception.frames import mean_frame as mean_frame
    from apex_ompl.perception.frames import save_sequence as save_sequence
    from apex_ompl.perception.hand_eye import Calibration as Calibration
    from apex_ompl.perception.hand_eye import View as View
    from apex_ompl.perception.hand_eye import calibrate as calibrate
    from apex_ompl.perception.held import HeldObject as HeldObject
    from apex_ompl.perception.held import HeldObjectFinder as HeldObjectFinder
    from apex_ompl.perception.held_settings import HeldSettings as HeldSettings
    from apex_ompl.perception.looking import LookSettings as LookSettings
    from apex_ompl.perception.looking import LookState as LookState
    from apex_ompl.perception.looking import ObjectView as ObjectView
    from apex_ompl.perception.looking import look_plan as look_plan
    from apex_ompl.perception.looking import look_states as look_states
    from apex_ompl.perception.obstacle_settings import ObstacleSettings as ObstacleSettings
    from apex_ompl.perception.obstacles import ObstacleFinder as ObstacleFinder
    from apex_ompl.perception.obstacles import SeenObstacle as SeenObstacle
    from apex_ompl.perception.occupancy import OccupancyMap as OccupancyMap
    from apex_ompl.perception.occupancy_settings import OccupancySettings as OccupancySettings
    from apex_ompl.perception.ros2_camera import Ros2Camera as Ros2Camera
    from apex_ompl.perception.sight import Sight as Sight
    from apex_ompl.perception.sight import see as see
    from apex_ompl.perception.solid_fit import KnownSize as KnownSize
    from apex_ompl.perception.synchronizer import Synchronizer as Synchronizer
    from apex_ompl.perception.tracking import ObstacleTracker as ObstacleTracker
    from apex_ompl.perception.tracking import TrackedObstacle as TrackedObstacle
    from apex_ompl.perception.tracking import TrackerSettings as TrackerSettings
    from apex_ompl.perception.twin_camera import TwinCamera as TwinCamera

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "alignment": "AlignSettings SeenTask vect_align",
        "bags": "bag_frames",
        "boards": "Board",
        "camera": "Camera DepthErrors look_at",
        "depth_scale": "measured_depths",
        "detection_fit": "DetectionFit",
        "detector": "DetectedObject DetectorSettings ObjectDetector",
        "frames": "Frame load_frames mean_frame save_sequence",
        "hand_eye": "Calibration View calibrate",
        "held": "HeldObject HeldObjectFinder",
        "held_settings": "HeldSettings",
        "looking": "LookSettings LookState ObjectView look_plan look_states",
        "obstacle_settings": "ObstacleSettings",
        "obstacles": "ObstacleFinder SeenObstacle",
        "occupancy": "OccupancyMap",
        "occupancy_settings": "OccupancySettings",
        "ros2_camera": "Ros2Camera",
        "solid_fit": "KnownSize",
        "sight": "Sight see",
        "synchronizer": "Synchronizer",
        "tracking": "ObstacleTracker TrackedObstacle TrackerSettings",
        "twin_camera": "TwinCamera",
    },  # fmt: skip
)
