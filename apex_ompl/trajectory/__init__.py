"""Trajectories: time parameterization of paths, motions over time, and their files."""

from __future__ import annotations

from apex_ompl.trajectory.timing import TimedPath, Timing, time_path, warm_up
from apex_ompl.trajectory.trajectory import Sample, Trajectory

__all__ = ["Sample", "TimedPath", "Timing", "Trajectory", "time_path", "warm_up"]
