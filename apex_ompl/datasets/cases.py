"""Problems as the kernel knows them, for machines without Pinocchio, Coal and OMPL.

They are written where those are, and solved anywhere from the straight line and from bumps; what the spheres prove is
kept. Parts of paths need Coal for the obstacle point at their start, and are left out.
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

from apex_ompl.datasets.engine import RECIPES, Case, Engine, Options, Row
from apex_ompl.datasets.records import SHAPES, Paths
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.compiled.arrays import SceneArrays
from apex_ompl.kernel.table_checks import scene_fault
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.trajopt.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.files import is_file, make_folder, write_atomically

SCHEMA = "apex-ompl/cases/1"


@dataclass(frozen=True, eq=False)
class WrittenCase:
    """A problem to be solved elsewhere.

    Attributes:
        unit: Name of the unit of work that it belongs to.
        suite: Its suite.
        level: Its level.
        recipe: How it is solved, see ``apex_ompl.datasets.engine.RECIPES``.
        row: What is written of it.
        robot: The robot, with what it holds.
        scene: The obstacles, fixtures among them.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        points: Obstacle points nearest to the robot at start and goal, shape (2, 3) [m].
    """

    unit: str
    suite: str
    level: str
    recipe: str
    row: Row
    robot: RobotTables
    scene: SceneTables
    start: Array
    goal: Array
    points: Array


def save_cases(folder: str | os.PathLike[str], cases: Sequence[WrittenCase]) -> None:
    """Write problems into a folder: ``tables-K.npz``, and last ``cases.npz``.

    Raises:
        MissingFileError: The folder cannot be written.
        ParameterError: There are no problems.
    """
    folder = Path(folder)
    if not cases:
        raise ParameterError("cases", 0, "one problem or more")
    make_folder(folder, "folder for problems")
    tables: list[RobotTables] = []
    head: list[dict[str, object]] = []
    for case in cases:
        if not any(case.robot is known for known in tables):
            tables.append(case.robot)
        number = next(k for k, known in enumerate(tables) if known is case.robot)
        things = [[shape, *map(list, numbers)] for shape, *numbers in case.row.things]
        names = {"unit": case.unit, "suite": case.suite, "level": case.level, "recipe": case.recipe}
        head.append({**names, "seed": case.row.seed, "held": case.row.held, "things": things, "tables": number})
    digests = []
    for k, known in enumerate(tables):
        known.save(folder / f"tables-{k}.npz")
        digests.append(hashlib.sha256((folder / f"tables-{k}.npz").read_bytes()).hexdigest())
    arrays: dict[str, Any] = {
        "start": np.stack([c.start for c in cases]), "goal": np.stack([c.goal for c in cases]),
        "points": np.stack([c.points for c in cases]),
    }  # fmt: skip
    for name in SceneArrays._fields:
        columns = [getattr(c.scene.arrays, name) for c in cases]
        arrays[name], arrays[f"{name}_count"] = np.concatenate(columns), np.array([len(c) for c in columns])
    stream = io.BytesIO()
    np.savez_compressed(
        stream, about=np.array(json.dumps({"schema": SCHEMA, "cases": head, "tables": digests})), **arrays
    )
    write_atomically(folder / "cases.npz", stream.getvalue())


def load_cases(folder: str | os.PathLike[str]) -> list[WrittenCase]:
    """Read problems that :func:`save_cases` wrote; needs NumPy and numba alone.

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
        rows = [Row(int(h["seed"]), str(h["held"]), [_thing(t) for t in h["things"]]) for h in head]
        names = [(str(h["unit"]), str(h["suite"]), str(h["level"]), str(h["recipe"])) for h in head]
        numbers = [int(h["tables"]) for h in head]
        if not head or not all(_sound(name) for name in names) or min(numbers) < 0 or max(numbers) >= len(head):
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
    places = zip(start, goal, points, strict=True)
    return [
        WrittenCase(*name, row, tables[number], scene, *place)
        for name, row, number, scene, place in zip(names, rows, numbers, scenes, places, strict=True)
    ]


def _scenes(arrays: dict[str, NDArray[Any]], count: int) -> list[SceneTables]:
    columns = {}
    for name in SceneArrays._fields:
        counts = arrays[f"{name}_count"]
        if len(counts) != count or counts.sum() != len(arrays[name]):
            raise ValueError(name)
        if counts.ndim != 1 or (counts < 0).any():
            raise ValueError(name)
        columns[name] = np.split(arrays[name], np.cumsum(counts)[:-1])
    made = [SceneArrays(**{k: np.ascontiguousarray(v[i]) for k, v in columns.items()}) for i in range(count)]
    for scene in made:
        fault = scene_fault(scene)
        if fault:
            raise ValueError(fault)
    return [SceneTables(scene) for scene in made]


def _sound(name: Sequence[str]) -> bool:
    """Whether names can be those of a unit of work, which become names of files, and its recipe is known."""
    return all(re.fullmatch(r"[A-Za-z0-9_-]{1,80}", part) for part in name) and name[3] in RECIPES


def _thing(numbers: Sequence[Any]) -> tuple[int, list[float], list[float], list[float]]:
    shape, place, turn, size = numbers
    found = int(shape), [float(v) for v in place], [float(v) for v in turn], [float(v) for v in size]
    if not 0 <= found[0] < len(SHAPES) or [len(v) for v in found[1:]] != [3, 4, 3]:
        raise ValueError("things")
    return found


def _tables(path: Path, digest: str) -> RobotTables:
    tables = RobotTables.load(path)
    if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
        raise FileFormatError(
            str(path), "", "another file", "expected the tables that these problems were written with"
        )
    return tables


def work_cases(cases: Sequence[WrittenCase], options: Options, spline: Spline) -> tuple[Paths, dict[str, float]]:
    """Solve the problems of one unit of work; the same arguments give the same paths.

    Returns:
        The paths, and where the time went [s].
    """
    first = cases[0]
    engine = Engine(first.unit, (first.suite, first.level), first.recipe, options, spline)
    for case in cases:
        task = Case(Kernel(case.robot, case.scene), case.start, case.goal, engine.optimizer)
        task.points = {q.tobytes(): p for q, p in zip((case.start, case.goal), case.points, strict=True)}
        engine.solve(task, case.row)
    return engine.paths(first.robot.name, first.robot.joint_names), engine.times
