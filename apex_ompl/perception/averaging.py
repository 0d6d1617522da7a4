"""Mean depth of several frames of a camera and a robot that stand still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.perception.frames import Frame

STILL = 2e-3  # difference of joints of a robot that stands still [rad; synergies 0..1]
NEAR = 0.03  # distance from the median within which depths are of the same surface [m]
LEAST_SHARE = 0.25  # of frames with a depth of a pixel


def mean_frame(frames: Sequence[Frame]) -> Frame:
    """Return the last of some frames with the mean depths of all.

    Depths further than 3 cm from a pixel's median do not count, and pixels with a depth in less than a quarter of the
    frames have none.

    Raises:
        ParameterError: There is no frame, or the camera or the robot has moved.
    """
    if not frames:
        raise ParameterError("frames", 0, "one frame or more")
    last = frames[-1]
    for frame in frames[:-1]:
        if frame.camera != last.camera:
            raise ParameterError("frames", frame.camera.name, f"frames of {last.camera.name!r} at one place")
        if frame.joints.keys() != last.joints.keys():
            raise ParameterError("frames", sorted(frame.joints), "the same joints in all frames")
        moved = max((abs(frame.joints[name] - value) for name, value in last.joints.items()), default=0.0)
        if moved > STILL:
            raise ParameterError("frames", f"a joint that moved by {moved:.3g}", "frames of a robot that stands still")
    if len(frames) == 1:
        return last
    depths = np.stack([frame.depth for frame in frames])
    there = depths > 0.0
    count = there.sum(axis=0)
    ordered = np.sort(np.where(there, depths, np.inf), axis=0)
    median = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    used = there & (np.abs(depths - np.where(np.isfinite(median), median, 0.0)) < NEAR)
    kept = used.sum(axis=0)
    mean = np.where(used, depths, 0.0).sum(axis=0) / np.maximum(kept, 1)
    return replace(last, depth=np.where(kept >= LEAST_SHARE * len(frames), mean, 0.0))
