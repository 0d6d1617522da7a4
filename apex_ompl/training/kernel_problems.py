"""Problems as tables of the kernel, to be solved on machines without Pinocchio, Coal and OMPL.

They are written on a machine that has those (:mod:`apex_ompl.training.units`). The data engine solves them from the
straight line and its random perturbations, and keeps the paths that the sphere cover proves free. Parts of paths are
left out: the obstacle point at their start needs Coal.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.arrays import GRID_ROW, SceneArrays
from apex_ompl.kernel.tables import SceneTables, scene_fault
from apex_ompl.model.geometry import SHAPES, ObstacleRecord
from apex_ompl.paths.spline import Spline
from apex_ompl.training.engine import STRATEGIES, Engine, EngineOptions, PathFinder, ProblemRecord
from apex_ompl.training.records import Paths
from apex_ompl.types import Array
from apex_ompl.util.files import is_file, make_folder, write_atomically

SCHEMA = "apex-ompl/cases/1"
STORED = tuple(name for name in SceneArrays._fields if name not in {"exact", "allowed", "grid", "values"})


@dataclass(frozen=True, eq=False)
class KernelProblem:
    """A problem as tables of the kernel.

    Attributes:
        unit: Name of its unit of work.
        suite: Its suite.
        level: Its level.
        strategy: How it is solved, a key of ``apex_ompl.training.engine.STRATEGIES``.
        record: Its record in a data set.
        robot: The robot with the held objects.
        scene: The obstacles, fixtures included.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        points: Obstacle points nearest to the robot at start and goal, shape (2, 3) [m].
    """

    unit: str
    suite: str
    level: str
    strategy: str
    record: ProblemRecord
    robot: RobotTables
    scene: SceneTables
    start: Array
    goal: Array
    points: Array


def save_kernel_problems(folder: str | os.PathLike[str], problems: Sequence[KernelProblem]) -> None:
    """Write problems into a folder: ``tables-K.npz`` with robots, then ``cases.npz``.

    Raises:
        MissingFileError: The folder cannot be written.
        ParameterError: There are no problems.
    """
    folder = Path(folder)
    if not problems:
        raise ParameterError("cases", 0, "one problem or more")
    make_folder(folder, "folder for problems")
    tables: list[RobotTables] = []
    head: list[dict[str, object]] = []
    for problem in problems:
        if not any(problem.robot is known for known in tables):
            tables.append(problem.robot)
        number = next(k for k, known in enumerate(tables) if known is problem.robot)
        record = problem.record
        things = [[shape, *map(list, numbers)] for shape, *numbers in record.obstacles]
        names = {"unit": problem.unit, "suite": problem.suite, "level": problem.level, "recipe": problem.strategy}
        head.append({**names, "seed": record.seed, "held": record.held, "things": things, "tables": number})
    digests = []
    for k, known in enumerate(tables):
        known.save(folder / f"tables-{k}.npz")
        digests.append(hashlib.sha256((folder / f"tables-{k}.npz").read_bytes()).hexdigest())
    arrays: dict[str, Any] = {
        "start": np.stack([p.start for p in problems]), "goal": np.stack([p.goal for p in problems]),
        "points": np.stack([p.points for p in problems]),
    }  # fmt: skip
    for name in STORED:
        columns = [getattr(p.scene.arrays, name) for p in problems]
        arrays[name], arrays[f"{name}_count"] = np.concatenate(columns), np.array([len(c) for c in columns])
    stream = io.BytesIO()
    np.savez_compressed(
        stream, about=np.array(json.dumps({"schema": SCHEMA, "cases": head, "tables": digests})), **arrays
    )
    write_atomically(folder / "cases.npz", stream.getvalue())


def load_kernel_problems(folder: str | os.PathLike[str]) -> list[KernelProblem]:
    """Read problems that :func:`save_kernel_problems` wrote; needs only NumPy and numba.

    Raises:
        MissingFileError: A file cannot be read.
        FileFormatError: A file holds something else.
    """
    path = Path(folder) / "cases.npz"
    if not is_file(path):
        raise MissingFileError(str(path), "file of problems")
    try:
        with np.load(path, allow_pickle=False) as data:
            about = json.loads(str(data["about"]))
            arrays = {name: data[name] for name in data.files if name != "about"}
        found = about["schema"]
    except Exception as error:  # NumPy, zipfile and json let many kinds through
        expected = "expected problems as the kernel knows them"
        raise FileFormatError(str(path), "", type(error).__name__, expected) from error
    if found != SCHEMA:
        raise FileFormatError(str(path), "schema", found, f"expected {SCHEMA!r}")
    try:
        head = about["cases"]
        scenes = _scenes(arrays, len(head))
        records = [ProblemRecord(int(h["seed"]), str(h["held"]), [_obstacle(t) for t in h["things"]]) for h in head]
        names = [(str(h["unit"]), str(h["suite"]), str(h["level"]), str(h["recipe"])) for h in head]
        numbers = [int(h["tables"]) for h in head]
        if not head or not all(_is_sound(name) for name in names) or min(numbers) < 0 or max(numbers) >= len(head):
            raise ValueError
        digests = about["tables"]
        tables = [_tables(path.parent / f"tables-{k}.npz", digests[k]) for k in range(max(numbers) + 1)]
        dofs = [tables[number].dof for number in numbers]
        start, goal, points = arrays["start"], arrays["goal"], arrays["points"]
        shapes = {"start": (len(head), dofs[0]), "goal": (len(head), dofs[0]), "points": (len(head), 2, 3)}
        if len(set(dofs)) > 1 or any(arrays[k].shape != v or arrays[k].dtype != float for k, v in shapes.items()):
            raise ValueError
        if not (np.isfinite(start).all() and np.isfinite(goal).all()):
            raise ValueError
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
        expected = "expected problems that fit each other"
        raise FileFormatError(str(path), str(error), "values that do not fit", expected) from error
    states = zip(start, goal, points, strict=True)
    return [
        KernelProblem(*name, record, tables[number], scene, *ends)
        for name, record, number, scene, ends in zip(names, records, numbers, scenes, states, strict=True)
    ]


def _scenes(arrays: dict[str, NDArray[Any]], count: int) -> list[SceneTables]:
    """Return the scenes whose concatenated arrays a file holds.

    Raises:
        ValueError: They do not fit each other.
    """
    columns = {}
    for name in STORED:
        counts = arrays[f"{name}_count"]
        if len(counts) != count or counts.sum() != len(arrays[name]):
            raise ValueError(name)
        if counts.ndim != 1 or (counts < 0).any():
            raise ValueError(name)
        columns[name] = np.split(arrays[name], np.cumsum(counts)[:-1])
    made = []
    for i in range(count):  # problems of data sets have neither grids nor bodies that may touch
        own = {name: np.ascontiguousarray(values[i]) for name, values in columns.items()}
        count = len(own["kind"])
        other: dict[str, Any] = {"exact": np.zeros(count, np.int64), "grid": np.zeros((count, GRID_ROW), np.int64)}
        other |= {"allowed": np.empty((0, 2), np.int64), "values": np.empty(0, np.float32)}
        made.append(SceneArrays(**own, **other))
    for scene in made:
        fault = scene_fault(scene)
        if fault:
            raise ValueError(fault)
    return [SceneTables(scene) for scene in made]


def _is_sound(name: Sequence[str]) -> bool:
    """Whether unit, suite and level can be part of a file's name, and the strategy is known."""
    return all(re.fullmatch(r"[A-Za-z0-9_-]{1,80}", part) for part in name) and name[3] in STRATEGIES


def _obstacle(numbers: Sequence[Any]) -> ObstacleRecord:
    """Return an obstacle from the lists of a file.

    Raises:
        ValueError: They are not those of an obstacle.
    """
    shape, position, orientation, size = numbers
    found = int(shape), [float(v) for v in position], [float(v) for v in orientation], [float(v) for v in size]
    if not 0 <= found[0] < len(SHAPES) or [len(v) for v in found[1:]] != [3, 4, 3]:
        raise ValueError("things")
    return found


def _tables(path: Path, digest: str) -> RobotTables:
    """Return the robot of a file.

    Raises:
        FileFormatError: The file is not the one that the problems were written with.
    """
    tables = RobotTables.load(path)
    if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
        raise FileFormatError(
            str(path), "", "another file", "expected the tables that these problems were written with"
        )
    return tables


def solve_kernel_problems(
    problems: Sequence[KernelProblem], options: EngineOptions, spline: Spline
) -> tuple[Paths, dict[str, float]]:
    """Solve the problems of one unit of work; the same arguments give the same paths.

    Returns:
        The paths, and the time by stage [s].
    """
    first = problems[0]
    engine = Engine(first.unit, (first.suite, first.level), first.strategy, options, spline)
    for problem in problems:
        start, goal = problem.start, problem.goal
        finder = PathFinder(Kernel(problem.robot, problem.scene), start, goal, engine.optimizer)
        finder.points = {q.tobytes(): p for q, p in zip((start, goal), problem.points, strict=True)}
        engine.solve(finder, problem.record)
    return engine.paths(first.robot.name, first.robot.joint_names), engine.times
