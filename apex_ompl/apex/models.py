"""What makes proposals for a robot."""

from __future__ import annotations

import json

from apex_ompl.apex.bumps import BumpModel
from apex_ompl.diffusion.checkpoint import CONFIG, SHIPPED, shared_model
from apex_ompl.diffusion.proposals import TrajectoryModel

DEFAULT = "apex"  # checkpoint that ships
AUTO, NONE = "auto", "none"  # names in the place of a checkpoint's


def has_model(robot: str) -> bool:
    """Whether a trained model ships for a robot."""
    try:
        config = json.loads((SHIPPED / DEFAULT / CONFIG).read_text(encoding="utf-8"))
        return bool(config["model"]["robot"] == robot)
    except (OSError, ValueError, KeyError):
        return False


def trajectory_model(name: str, robot: str, device: str = "cpu") -> TrajectoryModel | BumpModel:
    """Return a checkpoint's model for a robot, or random bumps.

    Args:
        name: Name or folder of a checkpoint; ``auto`` takes the one that ships for the robot, or ``none`` where there
            is none: random bumps of straight lines.
        robot: Name of the robot.
        device: Where a network runs.

    Raises:
        ApexError: The checkpoint cannot be loaded, or is of another robot.
    """
    if name == AUTO:
        name = DEFAULT if has_model(robot) else NONE
    return BumpModel() if name == NONE else shared_model(name, device=device, robot=robot)
