"""Trajectories: time parameterization of paths, motions over time, and their files."""

from __future__ import annotations

from apex_ompl.timing.motion_limits import MotionLimits
from apex_ompl.timing.parameterization import TimedPath, Timing, time_path, warm_up
from apex_ompl.timing.trajectory import Sample, Trajectory

__all__ = ["MotionLimits", "Sample", "TimedPath", "Timing", "Trajectory", "time_path", "warm_up"]
