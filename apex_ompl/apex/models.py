"""Models of proposals: the checkpoint for a robot, or random perturbations."""

from __future__ import annotations

from functools import cache

from apex_ompl.apex.perturbations import PerturbationModel
from apex_ompl.errors import MissingFileError
from apex_ompl.model.checkpoint import SHIPPED, read_config, shared_model
from apex_ompl.model.proposals import TrajectoryModel

DEFAULT = "apex"  # checkpoint that ships
AUTO, NONE = "auto", "none"  # names in the place of a checkpoint's

Model = TrajectoryModel | PerturbationModel
"""A model of proposals."""


def has_model(robot: str) -> bool:
    """Whether a trained model ships for a robot.

    Raises:
        FileFormatError: The configuration of the checkpoint that ships is damaged.
    """
    return _robot_of_default() == robot


@cache
def _robot_of_default() -> str | None:
    """Return the name of the robot of the checkpoint that ships, None where there is none."""
    try:
        return read_config(SHIPPED / DEFAULT).model.robot
    except MissingFileError:
        return None


def trajectory_model(name: str, robot: str, device: str = "cpu") -> Model:
    """Return a checkpoint's model for a robot, or random perturbations.

    Args:
        name: Name or folder of a checkpoint; ``auto`` takes the one that ships for the robot, or ``none`` where there
            is none: random perturbations of straight lines.
        robot: Name of the robot.
        device: Where a network runs.

    Raises:
        ApexError: The checkpoint cannot be loaded, or is of another robot.
    """
    if name == AUTO:
        name = DEFAULT if has_model(robot) else NONE
    return PerturbationModel() if name == NONE else shared_model(name, device=device, robot=robot)
