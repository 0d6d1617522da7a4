"""Problems as the kernel knows them, for machines without Pinocchio, Coal and OMPL.

They are written where those are, and solved anywhere from the straight line and from bumps; what the spheres prove is
kept. Parts of paths need Coal for the obstacle point at their start, and are left out.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.dataset import Paths
from apex_ompl.engine import Case, Engine, Options, Row
from apex_ompl.errors import FileFormatError, MissingFileError, ParameterError
from apex_ompl.files import is_file, write_atomically
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.tables import SceneArrays, SceneTables
from apex_ompl.spline import Spline

Array = NDArray[np.float64]

SCHEMA = "apex-ompl/cases/1"
HEAD = ("unit", "suite", "level", "recipe", "seed", "held", "things", "tables")


@dataclass(frozen=True, eq=False)
class WrittenCase:
    """A problem to be solved elsewhere.

    Attributes:
        unit: Name of the unit of work that it belongs to.
        suite: Its suite.
        level: Its level.
        recipe: How it is solved, see ``apex_ompl.engine.RECIPES``.
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
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise MissingFileError(str(folder), "folder for problems", str(error.strerror).lower()) from error
    tables: list[RobotTables] = []
    head: list[dict[str, object]] = []
    for case in cases:
        if not any(case.robot is known for known in tables):
            tables.append(case.robot)
        number = next(k for k, known in enumerate(tables) if known is case.robot)
        things = [[shape, *map(list, numbers)] for shape, *numbers in case.row.things]
        about = {"unit": case.unit, "suite": case.suite, "level": case.level, "recipe": case.recipe}
        head.append({**about, "seed": case.row.seed, "held": case.row.held, "things": things, "tables": number})
    for k, known in enumerate(tables):
        known.save(folder / f"tables-{k}.npz")
    arrays: dict[str, Any] = {
        "start": np.stack([c.start for c in cases]), "goal": np.stack([c.goal for c in cases]),
        "points": np.stack([c.points for c in cases]),
    }  # fmt: skip
    for name in SceneArrays._fields:
        columns = [getattr(c.scene.arrays, name) for c in cases]
        arrays[name], arrays[f"{name}_count"] = np.concatenate(columns), np.array([len(c) for c in columns])
    stream = io.BytesIO()
    np.savez_compressed(stream, about=np.array(json.dumps({"schema": SCHEMA, "cases": head})), **arrays)
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
        head = about["cases"] if about["schema"] == SCHEMA else []
        scenes = _scenes(arrays, len(head))
        rows = [Row(h["seed"], h["held"], [(t[0], t[1], t[2], t[3]) for t in h["things"]]) for h in head]
        numbers = [int(h["tables"]) for h in head]
        places = list(zip(arrays["start"], arrays["goal"], arrays["points"], strict=True)) if head else []
        names = [(str(h["unit"]), str(h["suite"]), str(h["level"]), str(h["recipe"])) for h in head]
    except Exception as error:  # NumPy, zipfile and json let many kinds through
        raise FileFormatError(
            str(path), "", type(error).__name__, "expected problems as the kernel knows them"
        ) from error
    if about["schema"] != SCHEMA:
        raise FileFormatError(str(path), "schema", about["schema"], f"expected {SCHEMA!r}")
    tables = [RobotTables.load(path.parent / f"tables-{k}.npz") for k in range(max(numbers, default=-1) + 1)]
    dofs = [tables[number].dof for number in numbers]
    if len(places) != len(head) or any(len(p[0]) != dof for p, dof in zip(places, dofs, strict=True)):
        raise FileFormatError(str(path), "start", "states of another robot", "expected as many numbers as joints")
    return [
        WrittenCase(*name, row, tables[number], scene, *place)
        for name, row, number, scene, place in zip(names, rows, numbers, scenes, places, strict=True)
    ]


def _scenes(arrays: dict[str, NDArray[np.generic]], count: int) -> list[SceneTables]:
    columns = {}
    for name in SceneArrays._fields:
        counts = arrays[f"{name}_count"]
        if len(counts) != count or counts.sum() != len(arrays[name]):
            raise ValueError(name)
        columns[name] = np.split(arrays[name], np.cumsum(counts)[:-1])
    made = [SceneArrays(**{k: np.ascontiguousarray(v[i]) for k, v in columns.items()}) for i in range(count)]
    for scene in made:
        things = {len(scene.kind), len(scene.owner), len(scene.rotation), len(scene.offset), len(scene.size)}
        boxes = {len(scene.tree_skip), len(scene.tree_range), len(scene.tree_low), len(scene.tree_high)}
        if len(things) > 1 or len(boxes) > 1 or len(scene.open) != 1:
            raise ValueError("scene")
    return [SceneTables(scene) for scene in made]


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
    return engine.paths(first.robot.dof), engine.times
