"""Motions over time: time parameterisation, and the files of trajectories."""

from __future__ import annotations

from apex_ompl.trajectory.motion import Sample, Trajectory
from apex_ompl.trajectory.timing import TimedPath, Timing, time_path, warm_up

__all__ = ["Sample", "TimedPath", "Timing", "Trajectory", "time_path", "warm_up"]
