"""Generation of a data set: units of work are solved in this process or by Ray, and stored as they are done."""

from __future__ import annotations

import math
import platform
import time
from collections import Counter
from collections.abc import Callable, Generator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from apex_ompl.kernel import RobotTables
from apex_ompl.paths.spline import Spline
from apex_ompl.training.engine import EngineOptions
from apex_ompl.training.records import Paths
from apex_ompl.training.store import Store
from apex_ompl.util.cluster import spread
from apex_ompl.util.provenance import versions

LIBRARIES = ("apex-ompl", "ompl", "pin", "coal", "numba", "numpy", "zarr")
SAME = (
    "robot", "joints", "seed", "copies", "parts", "model", "control_points", "pinned", "degree", "problems_per_unit",
)  # fmt: skip
"""Entries of the manifest in which a data set agrees with what is added to it."""

Solve = Callable[[Any, EngineOptions, Spline], tuple[Paths, dict[str, float]]]
"""A function from a unit of work, options and spline to paths and the time by stage [s]."""
Solved = tuple[str, Paths, dict[str, float]]
Report = Callable[[str, int, float], object]
"""Called with the name of a unit that is done, the number of paths of this run, and its time [s]."""


@dataclass(frozen=True, eq=False)
class Work:
    """What is to be generated.

    Attributes:
        solve: Solves a unit.
        units: The units by name, in the order in which they are solved.
        about: Robot, joints and size of units, for the manifest.
        tables: The robot with empty hands; None where it is unknown.
    """

    solve: Solve
    units: Mapping[str, Any]
    about: Mapping[str, Any]
    tables: RobotTables | None


@dataclass(frozen=True)
class Generation:
    """Settings of a generation.

    Attributes:
        options: Options of the engine.
        spline: Spline of the paths.
        workers: Processes; several are run by Ray.
        address: Address of a Ray cluster; None for this machine.
        seconds: Time after which no more units are stored [s].
        least: Number of paths, and of units, of which one must be reached before.
    """

    options: EngineOptions = EngineOptions()
    spline: Spline = Spline()
    workers: int = 1
    address: str | None = None
    seconds: float = math.inf
    least: tuple[int, int] = (0, 0)


class Generated(NamedTuple):
    """Outcome of a generation.

    Attributes:
        paths: Number of paths of this run.
        seconds: Time of this run [s].
        total: Numbers of units, paths and solved problems of the whole set, and the sums of its statistics.
    """

    paths: int
    seconds: float
    total: dict[str, Any]


def generate(folder: Path, work: Work, settings: Generation, report: Report = lambda *_: None) -> Generated:
    """Solve the units that a data set lacks, until the time is over.

    Args:
        folder: Folder of the data set.
        work: What is to be generated.
        settings: Settings.
        report: Called after each unit.

    Raises:
        DatasetError: The data set in the folder was made with other options, or zarr is missing.
        ClusterError: Ray is missing, or a worker failed.
    """
    spline, options = settings.spline, settings.options
    manifest = {
        **work.about, **asdict(options), "control_points": spline.points, "pinned": spline.pinned,
        "degree": spline.degree, "split": "train", "python": platform.python_version(),
        "versions": versions(LIBRARIES),
    }  # fmt: skip
    store = Store.create(folder, manifest, SAME)
    with store.locked():
        if work.tables is not None:
            work.tables.save(store.folder / "robot.npz")
        there = set(store.units())
        left = {name: unit for name, unit in work.units.items() if name not in there}
        paths, seconds = _write_units(store, _solved(work.solve, left, settings), settings, report)
        total = summary(store)
        store.note(counts=total)
    return Generated(paths, seconds, total)


def _solved(solve: Solve, units: Mapping[str, Any], settings: Generation) -> Generator[Solved]:
    """Yield name, paths and times of units as they are solved."""
    options, spline = settings.options, settings.spline
    if not units or (settings.workers == 1 and settings.address is None):
        for name, unit in units.items():
            yield name, *solve(unit, options, spline)
        return
    jobs = {name: (unit, options, spline) for name, unit in units.items()}
    for name, (paths, times) in spread(solve, jobs, workers=settings.workers, address=settings.address):
        yield name, paths, times


def _write_units(
    store: Store, source: Generator[Solved], settings: Generation, report: Report
) -> tuple[int, float]:  # fmt: skip
    """Write the units, and note the run in the manifest; return the number of paths, and the time [s]."""
    started, done, paths, times = time.perf_counter(), 0, 0, Counter[str]()
    seconds = 0.0
    try:
        for name, found, spent in source:
            store.write(name, found)
            done, paths = done + 1, paths + len(found)
            times.update(spent)
            seconds = time.perf_counter() - started
            report(name, paths, seconds)
            enough = paths >= settings.least[0] or done >= settings.least[1]
            if seconds >= settings.seconds and enough:
                break
    finally:
        source.close()
        seconds = time.perf_counter() - started
        if done:
            run: dict[str, Any] = {
                "workers": settings.workers,
                "seconds": round(seconds, 1),
                "units": done,
                "paths": paths,
            }
            run["worker_seconds"] = {stage: round(value, 1) for stage, value in sorted(times.items())}
            store.note(runs=[*store.manifest.get("runs", []), run])
    return paths, max(seconds, 1e-9)


def summary(store: Store) -> dict[str, Any]:
    """Return the number of units, paths and problems of a data set, and the sums of its statistics."""
    total: Counter[str] = Counter(units=0, paths=0, solved=0)
    for paths in store:
        total.update({"units": 1, "paths": len(paths)})
        total.update({key: n for key, n in paths.counts.items() if isinstance(n, int)})
        total["unsolved"] += len(paths.counts.get("unsolved", ()))
    return dict(total)
