"""What pictures and pages show: saved plans and runs, and the curves of their motions over time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import ARCHIVE, RunResult
from apex_ompl.planning.task_result import TaskResult, load_result
from apex_ompl.result import PlanResult
from apex_ompl.robot import Robot
from apex_ompl.robot.identity import load_same_robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there, obstacle_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.files import BROKEN, is_file

Saved: TypeAlias = PlanResult | RunResult
SUFFIXES, HEAD = (".json", ".npz", ".yaml", ".yml"), 2000  # of files, and the characters that name the schema
SCHEMAS = re.compile(r"apex-ompl/(result|run)/")
ORDERS = ("position", "velocity", "acceleration", "jerk")


def saved_kind(path: Path) -> type[PlanResult] | type[RunResult] | None:
    """Return the kind of a saved file by its start, a plan or a run, or None for other files."""
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
    return RunResult.load(path) if saved_kind(path) is RunResult else load_result(path)


def robot_of(saved: Saved) -> Robot:
    """Return the robot of a saved plan or run.

    Raises:
        RobotError: It has changed since.
        ParameterError: Its joints differ from those of the motion.
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


def shares_of_limits(motion: Trajectory, robot: Robot, times: Array) -> Array:
    """Return position, velocity, acceleration and jerk as shares of the limits, shape (4, N, dof).

    1 is the upper limit, -1 the lower one.

    Args:
        motion: The motion.
        robot: Its robot.
        times: Shape (N,) [s].
    """
    limits = robot.limits
    center, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
    bounds = (limits.velocity, limits.acceleration, limits.jerk)
    scaled = [(motion(times) - center) / half]
    return np.stack([*scaled, *(motion(times, order) / bound for order, bound in enumerate(bounds, 1))])


def clearances(checker: CollisionChecker, motion: Trajectory, times: Array, dynamic: Sequence[Obstacle] = ()) -> Array:
    """Return the clearance of a motion at some times, shape (N,) [m].

    Args:
        checker: The robot in its scene.
        motion: The motion.
        times: Shape (N,) [s].
        dynamic: Dynamic obstacles of the scene; each is at its position at each time, once it has appeared.
    """
    found, among = [], dict[frozenset[str], CollisionChecker]()
    for time, q in zip(times.tolist(), motion(times), strict=True):
        here = [obstacle_at(one, time) for one in dynamic if is_there(one, time)]
        names = frozenset(one.name for one in here)
        if names not in among:
            among[names] = _among(checker, dynamic, here)
        for one in here:
            among[names].move(one.name, one.position)
        found.append(among[names].clearance(q))
    return np.array(found)


def clearances_of(result: PlanResult, checker: CollisionChecker, times: Array) -> Array:
    """Return the clearance of the motion of a result at some times, shape (N,) [m]; of a task with what it holds then.

    Args:
        result: A result with a timed motion.
        checker: The robot in the scene of its problem.
        times: Shape (N,) [s].
    """
    motion = result.trajectory
    assert motion is not None
    if not isinstance(result, TaskResult):
        dynamic = [one for one in result.problem.scene if one.name in result.dynamic_obstacles]
        return clearances(checker, motion, times, dynamic)
    steps, made = [result.step_at(time) for time in times.tolist()], dict[str, CollisionChecker]()
    found = []
    for step, q in zip(steps, motion(times), strict=True):
        key = f"{step.start}"
        if key not in made:
            made[key] = CollisionChecker(checker.robot, step.scene, step.attached, step.allowed)
        found.append(made[key].clearance(q))
    return np.array(found)


def _among(checker: CollisionChecker, dynamic: Sequence[Obstacle], here: Sequence[Obstacle]) -> CollisionChecker:
    """Return a checker with the dynamic obstacles that are present."""
    if not dynamic:
        return checker
    names, present = {one.name for one in dynamic}, {one.name for one in here}
    scene = [*(o for o in checker.obstacles.values() if o.name not in names), *here]
    pairs = [pair for pair in checker.allowed if not {*pair} & (names - present)]
    return CollisionChecker(checker.robot, scene, checker.held.values(), pairs)
