"""Whether a motion can be followed behind what a request says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.moving.following import SAME_TIME, Following
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Request

SAME_STATE = 1e-7  # largest jump of positions, velocities and accelerations where a motion begins


def misfit(ready: Ready, found: Following, request: Request) -> str:
    """Return why a motion can never be followed behind what a request says, or nothing.

    Args:
        ready: The robot among what stands still.
        found: The motion.
        request: What was asked for.
    """
    motion = found.motion
    try:
        replace(motion)  # it may come from another process, and be none at all
    except ParameterError as error:
        return f"it is no motion: {error}"
    if motion.joint_names != ready.names:
        return "it is a motion of other joints"
    behind = request.following.start(request.join)
    states = motion.positions[0], motion.velocities[0], motion.accelerations[0]
    off = max(float(np.abs(one - other).max()) for one, other in zip(states, behind, strict=True))
    if abs(found.begin - request.join) > SAME_TIME or not off <= SAME_STATE:
        return "it does not begin where the robot will be"
    if motion.velocities[-1].any() or motion.accelerations[-1].any():
        return "it does not end at rest"
    if found.to_goal and not ready.is_goal(motion.positions[-1]):
        return "it does not end at a goal"
    verified = ready.settings.verified
    if not (ready.clear_of_still(motion) if verified else ready.keeps_limits(motion)):
        return "it exceeds limits, or is not proved clear of what stands still"
    return ""
