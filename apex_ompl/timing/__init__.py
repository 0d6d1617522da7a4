"""Trajectories: time parameterization of paths, motions over time, and their files."""

from __future__ import annotations

from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.parameterization import TimedPath, Timing, time_path, warm_up
from apex_ompl.timing.samples import Sample
from apex_ompl.timing.trajectory import Trajectory, joined

__all__ = ["MotionLimits", "Sample", "TimedPath", "Timing", "Trajectory", "joined", "time_path", "warm_up"]
