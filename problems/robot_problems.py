"""Problems of the suite ``broad`` for any robot with arms.

Their ids carry the name of the robot: ``dual_ur5/broad/rack/12``. Robots are given by their files, since the names of
those that do not ship are not known. The levels are those of ``broad`` without alignments.
"""

from __future__ import annotations

import zlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from apex_ompl.problems import broad
from apex_ompl.problems.broad_tasks import OPEN
from apex_ompl.problems.catalogue import SuiteError
from apex_ompl.problems.robot_cells import cell_of
from apex_ompl.problems.suite_robot import DrawnProblem
from apex_ompl.robot import Robot, load_robot
from apex_ompl.scene.problem import Problem

LEVELS = tuple(level for level in broad.LEVELS[broad.SUITE] if level != "alignment")
MAX_DRAWS = 8  # for one problem, before it is abandoned


def robot_of(file: str) -> Robot:
    """Return the robot of a file or a name, read again where the file has changed.

    Raises:
        ApexError: As :func:`load_robot`.
    """
    path = Path(file)
    return _loaded(file, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=4)
def _loaded(file: str, stamp: int) -> Robot:
    return load_robot(file)


def drawn_for(robot: Robot, level: str, seed: int) -> DrawnProblem:
    """Return the problem of a level for a robot; the same seed gives the same problem.

    Raises:
        RobotError: The robot has no arms.
        SuiteError: No start and no goal were found.
    """
    cell, number = cell_of(robot), zlib.crc32(f"{broad.SUITE}/{level}".encode())
    for draw in range(MAX_DRAWS):
        rng = np.random.default_rng([number, seed, draw])
        if level in broad.SIMPLE_LEVELS:
            drawn = broad.draw_simple(rng, level, OPEN, cell)
        else:
            drawn = broad.draw(rng, broad.SUITE, level, cell)
        if drawn is not None:
            return drawn
    raise SuiteError(f"problem {name_of(robot, level, seed)}: none of {MAX_DRAWS} draws has a start and a goal")


def name_of(robot: Robot, level: str, seed: int) -> str:
    """Return the id of a problem for a robot."""
    return f"{robot.name}/{broad.SUITE}/{level}/{seed}"


def problem_of(drawn: DrawnProblem, file: str, level: str, seed: int) -> Problem:
    """Return a drawn problem for the robot of a file."""
    robot = robot_of(file)
    return drawn.to_problem(name_of(robot, level, seed), robot).model_copy(update={"robot": file})
