"""Files of what is shown: saved plans and saved runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeAlias

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import ARCHIVE, RunResult
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.robot.identity import load_same_robot
from apex_ompl.util.files import BROKEN, is_file

Saved: TypeAlias = PlanResult | RunResult
SUFFIXES, HEAD = (".json", ".npz", ".yaml", ".yml"), 2000  # of files, and the characters that name the schema
SCHEMAS = re.compile(r"apex-ompl/(result|run)/")


def saved_kind(path: Path) -> type[PlanResult] | type[RunResult] | None:
    """Return what a file holds by its beginning, a plan or a run, or None for anything else."""
    if path.suffix not in SUFFIXES or not is_file(path):
        return None
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as archive:
                found = next((name for name in ("result", ARCHIVE) if name in archive.files), "")
        else:
            with path.open(encoding="utf-8") as text:
                schema = SCHEMAS.search(text.read(HEAD))
            found = schema[1] if schema else ""
    except (OSError, AttributeError, *BROKEN):
        return None
    return {"result": PlanResult, "run": RunResult}.get(found)


def is_saved(path: Path) -> bool:
    """Whether a file is, or by its name should be, a saved plan or run rather than a problem."""
    return path.suffix in (".npz", ".json") or saved_kind(path) is not None


def load_saved(path: Path) -> Saved:
    """Read a saved plan or run.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It holds neither.
        ParameterError: It has another suffix.
    """
    return (saved_kind(path) or PlanResult).load(path)


def robot_of(saved: Saved) -> Robot:
    """Return the robot of a saved plan or run.

    Raises:
        RobotError: It is another one by now.
        ParameterError: It has other joints than the motion.
        ApexError: It cannot be loaded.
    """
    robot, motion = load_same_robot(saved.problem.robot, saved.robot_digest), saved.trajectory
    if motion is not None and motion.joint_names != robot.joint_names:
        raise ParameterError("trajectory", ", ".join(motion.joint_names), f"the joints of {robot.name}, in their order")
    return robot


def saved_in(folder: Path) -> list[Path]:
    """Return the files of plans and runs in a folder and below, sorted by name.

    Raises:
        ParameterError: There are none.
    """
    found = [path for path in sorted(folder.rglob("*")) if saved_kind(path) is not None]
    if not found:
        raise ParameterError("folder", str(folder), "one with results: files written by plan --out or bench --keep")
    return found
