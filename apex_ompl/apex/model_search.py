"""Where the trained model of a robot is found.

A model is for the robot whose digest its checkpoint records. Looked up are, in this order, the checkpoint that the
robot file names, the one that ships, and the folders of ``APEX_OMPL_MODELS`` and of the user's data, each a checkpoint
or a folder of checkpoints. The checkpoints that ship are for the robots that ship under the names they record.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from apex_ompl.errors import ApexError, FileFormatError, MissingFileError
from apex_ompl.model.checkpoint import CONFIG, SHIPPED, checkpoint_folder, read_config
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.identity import digest
from apex_ompl.robot.model import robot_names
from apex_ompl.util.files import is_file

DEFAULT = "apex"  # checkpoint that ships
AUTO, NONE = "auto", "none"  # names in the place of a checkpoint's
VARIABLE = "APEX_OMPL_MODELS"  # folders, separated as those of PATH
DIGEST = "robot_digest"  # in the record of a training


class FoundModel(NamedTuple):
    """The checkpoint of a robot.

    Attributes:
        name: Name or folder of the checkpoint; ``none`` where there is none.
        note: Why there is none, a clause.
    """

    name: str
    note: str = ""


def find_model(robot: Robot) -> FoundModel:
    """Return the checkpoint for a robot.

    Raises:
        MissingFileError: The checkpoint that the robot file names is missing.
        FileFormatError: It is damaged, or the configuration of the one that ships is.
    """
    note = f"no model of {robot.name} was found"
    if robot.checkpoint is not None:
        folder = str(robot.checkpoint)
        fault = robot_fault(folder, robot)
        if fault is None:
            return FoundModel(folder)
        note = f"the model {folder} is of another robot than {robot.name} is now"
    if _robot_of_default() == robot.name and _ships(robot):
        return FoundModel(DEFAULT)
    for path in _candidates():
        try:
            found = read_config(path).trained.get(DIGEST)
        except ApexError:  # one of the others may be sound
            continue
        if found == digest(robot):
            return FoundModel(str(path))
    return FoundModel(NONE, note)


def model_notes(robot: Robot) -> list[str]:
    """Return a sentence where there is no model for a robot, else none.

    Raises:
        ApexError: As :func:`find_model`.
    """
    found = find_model(robot)
    return [f"{found.note}, so random perturbations take the place of proposals"] if found.name == NONE else []


def robot_fault(name: str | os.PathLike[str], robot: Robot) -> FileFormatError | None:
    """Return the error of a checkpoint that is of another robot, or None.

    A checkpoint that records no digest is only known by the name of its robot.

    Raises:
        ApexError: There is no such checkpoint, or it is damaged.
    """
    folder = checkpoint_folder(name)
    config = read_config(folder)
    if config.model.robot != robot.name:
        return FileFormatError(str(folder / CONFIG), "model.robot", config.model.robot, f"expected {robot.name!r}")
    found = config.trained.get(DIGEST)
    if found is not None and found != digest(robot):
        expected = f"expected {digest(robot)}, the robot {robot.name!r} as it is now; train a model for it"
        return FileFormatError(str(folder / CONFIG), f"trained.{DIGEST}", found, expected)
    return None


def data_folder() -> Path | None:
    """Return the folder of checkpoints in the user's data, which need not exist; None without a home folder."""
    try:
        home = Path(os.environ.get("XDG_DATA_HOME") or "~/.local/share").expanduser()
    except RuntimeError:
        return None
    return home / "apex_ompl" / "models"


def _candidates() -> Iterator[Path]:
    """Yield the checkpoints of the search path."""
    folders = [Path(text).expanduser() for text in os.environ.get(VARIABLE, "").split(os.pathsep) if text]
    folders += [folder for folder in (data_folder(),) if folder is not None]
    for folder in folders:
        try:
            places = [folder, *sorted(folder.iterdir())]
        except OSError:
            continue
        yield from (path for path in places if is_file(path / CONFIG))


def _ships(robot: Robot) -> bool:
    """Whether a robot is the one that ships under its name."""
    if robot.name not in robot_names():
        return False
    known = load_robot(robot.name)
    return robot is known or digest(robot) == digest(known)


@cache
def _robot_of_default() -> str | None:
    """Return the name of the robot of the checkpoint that ships, None where there is none."""
    try:
        return read_config(SHIPPED / DEFAULT).model.robot
    except MissingFileError:
        return None
