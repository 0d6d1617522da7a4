"""What is computed once for a robot: pairs of links that need no check, and sphere covers of its links.

Files are written beside the robot file as soon as there is something to write, and name how far they are, so that a
preparation that was stopped goes on where it was. Covers are made quickly for all links first, then tables of the
clearances of near links that these leave open, and pairs are searched, for which the covers save most checks of meshes.
Last, the covers of the links that still spoil most proofs are made anew, thoroughly, as long as the time lasts.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np

from apex_ompl.collision.checker import CollisionChecker
from apex_ompl.collision.clearance_making import TableReport, prepare_clearances
from apex_ompl.collision.cover.neighbors import grazing_links
from apex_ompl.collision.cover.pairs import GRAZE, PairSearch, disabled_pairs
from apex_ompl.collision.cover.proof import Cover
from apex_ompl.collision.cover.spheres import FULL, make_cover, read_covers, read_efforts, shape_key, write_covers
from apex_ompl.collision.cover.survey import proved_share
from apex_ompl.collision.links import Links
from apex_ompl.robot.config import RobotConfig, read_config, read_disabled_pairs_file
from apex_ompl.robot.identity import digest
from apex_ompl.robot.model import Robot, bare_robot, build_robot, link_of
from apex_ompl.robot.new import pairs_text
from apex_ompl.util.files import check_writable, read_text, write_atomically
from apex_ompl.util.validation import check_integer, check_positive

SAMPLES = 500  # states at which it is measured which links spoil proofs
QUICK_SHARE, PAIRS_SHARE = 0.5, 0.2  # of the budget, for quick covers at first, and for pairs
TABLES_SHARE, MOST_FOR_TABLES = 0.5, 60.0  # of the time that is left then, for tables of near links, and most [s]
COMMAND = "apex-ompl robot prepare"


@dataclass(frozen=True)
class Preparation:
    """Settings of a preparation.

    Attributes:
        budget: Time that it may take by the wall clock [s]; infinite for as long as it takes.
        jobs: Processes at once.
        effort: Most thorough search for covers, 1 to 3.
        pairs: Settings of the search for pairs.
    """

    budget: float = 300.0
    jobs: int = 1
    effort: int = FULL
    pairs: PairSearch = PairSearch()

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.budget != np.inf:
            check_positive(self.budget, "budget", "a positive number of seconds")
        check_integer(self.jobs, "jobs", 1)
        check_integer(self.effort, "effort", 1, FULL)


class Prepared(NamedTuple):
    """Outcome of a preparation.

    Attributes:
        pairs: Pairs of links in the file of disabled pairs.
        grazing: Those of them that touch as bearings do, and are not checked for that.
        covers: Effort -> number of shapes whose covers were made by it, in all runs.
        missing: Shapes without a cover in the file.
        thorough: Whether nothing is left to do.
        files: The files of pairs, covers and tables of clearances.
    """

    pairs: int
    grazing: tuple[tuple[str, str], ...]
    covers: dict[int, int]
    missing: int
    thorough: bool
    files: tuple[Path, ...]


Report = Callable[[str, float], object]
"""Called with the name of a stage and the share of it that is done."""


def prepare(path: Path, settings: Preparation | None = None, report: Report = lambda stage, share: None) -> Prepared:
    """Prepare a robot, and name the files in its robot file.

    Args:
        path: The robot file.
        settings: Settings.
        report: Called with the progress.

    Raises:
        MissingFileError: A file is missing, or one cannot be written.
        ApexError: The robot is faulty.
    """
    settings = settings or Preparation()
    deadline = time.monotonic() + settings.budget
    robot, config, path = bare_robot(str(path))
    stem = path.name.split(".")[0]
    pairs_file = path.parent / (config.disabled_pairs or f"{stem}.pairs.yaml")
    covers_file = path.parent / (config.covers or f"{stem}.spheres.json")
    for file in (path, pairs_file, covers_file):
        check_writable(file)
    covers = _Covers(robot, covers_file, settings, report)
    covers.make(covers.all, 1, time.monotonic() + QUICK_SHARE * settings.budget)
    files, links, known = [pairs_file], None, dict[str, str | None]()
    if covers_file.exists():
        name_in(path, {"covers": covers_file})
        known = {"covers": str(covers_file), "disabled_pairs": str(pairs_file) if pairs_file.exists() else None}
        files += [covers_file, *_prepare_tables(build_robot(config.model_copy(update=known), path), deadline, report)]
    if not covers.missing:
        links = Links.of(build_robot(config.model_copy(update=known | {"disabled_pairs": None}), path))
    count, complete = _prepare_pairs(robot, config, pairs_file, settings, report, links=links)
    name_in(path, {"disabled_pairs": pairs_file})
    if covers_file.exists():
        if covers.missing:
            covers.make(covers.all, 1, deadline)
        if settings.effort > 1 and time.monotonic() < deadline:
            covers.make(_weights(path, robot), settings.effort, deadline)
    efforts = [covers.efforts.get(key, 0) for key in covers.shapes]
    numbers = {effort: efforts.count(effort) for effort in sorted({*efforts} - {0})}
    thorough = complete and min(efforts, default=FULL) >= settings.effort
    return Prepared(count, grazing_links(pairs_file), numbers, covers.missing, thorough, tuple(files))


def _prepare_tables(robot: Robot, deadline: float, report: Report) -> list[Path]:
    """Write the tables of clearances of links that the covers leave open, and return their file."""
    stage, seconds = "near links", min(MOST_FOR_TABLES, TABLES_SHARE * (deadline - time.monotonic()))
    if seconds <= 0.0:
        return []
    spent = 0.0

    def progress(made: TableReport) -> None:
        nonlocal spent
        spent += made.seconds
        report(stage, min(1.0, spent / seconds))

    file = prepare_clearances(robot, seconds, progress)
    report(stage, 1.0)
    return [] if file is None else [file]


def _prepare_pairs(
    robot: Robot, config: RobotConfig, file: Path, settings: Preparation, report: Report, *, links: Links | None
) -> tuple[int, bool]:
    """Write the file of disabled pairs unless it is this robot's; return the number, and whether all were decided."""
    search, deadline = settings.pairs, time.monotonic() + PAIRS_SHARE * settings.budget
    command = f"{COMMAND} --samples {search.samples} --margin {search.margin:g} --seed {search.seed}"
    command += "".join(f" --soft {part}" for part in search.soft)
    command += f" --graze {search.graze:g}" if search.graze != GRAZE else ""
    known = read_disabled_pairs_file(file) if file.exists() else None
    if known is not None and known.command == command and known.robot == digest(robot):
        return len(known.pairs), True
    found = disabled_pairs(robot, config, search, deadline, lambda share: report("pairs of links", share), links=links)
    complete = time.monotonic() < deadline
    write_atomically(file, pairs_text(found, command if complete else f"{command}, stopped", digest(robot)).encode())
    return len(found), complete


class _Covers:
    """Covers of the shapes of a robot, and their file."""

    def __init__(self, robot: Robot, file: Path, settings: Preparation, report: Report) -> None:
        self.file, self.jobs, self.report = file, settings.jobs, report
        self.shapes = {shape_key(item.geometry): item.geometry for item in robot.geometry.geometryObjects}
        self.covers: dict[str, Cover] = read_covers(file) if file.exists() else {}
        self.efforts = read_efforts(file) if file.exists() else {}

    @property
    def all(self) -> dict[str, float]:
        """Equal weights of all shapes."""
        return dict.fromkeys(self.shapes, 1.0)

    @property
    def missing(self) -> int:
        """Number of shapes without a cover."""
        return sum(key not in self.covers for key in self.shapes)

    def make(self, weights: Mapping[str, float], effort: int, deadline: float) -> None:
        """Make the covers that were not made by an effort yet, those of the largest weights first."""
        waiting = [
            key for key in sorted(self.shapes, key=lambda key: (-weights.get(key, 0.0), _size(self.shapes[key])))
        ]
        waiting = [key for key in waiting if self.efforts.get(key, 0) < effort]
        stage = "quick covers" if effort == 1 else "thorough covers"
        with _made({key: self.shapes[key] for key in waiting}, effort, self.jobs, deadline) as made:
            for k, (key, cover) in enumerate(made):
                self.covers[key], self.efforts[key] = cover, effort
                write_covers(self.file, self.covers, self.efforts)
                self.report(stage, (k + 1) / len(waiting))


def _size(shape: coal.CollisionGeometry) -> int:
    return int(getattr(shape, "num_tris", 0))


@contextmanager
def _made(
    shapes: Mapping[str, coal.CollisionGeometry], effort: int, jobs: int, deadline: float
) -> Iterator[Iterator[tuple[str, Cover]]]:
    """Make covers in processes that end at the deadline; yield key and cover as each is done."""
    if not shapes or time.monotonic() >= deadline:
        yield iter(())
        return
    pool = multiprocessing.get_context("fork").Pool(min(jobs, len(shapes)), _start, (shapes,))
    try:
        yield _until(deadline, pool.imap_unordered(_make, [(key, effort) for key in shapes]))
    finally:
        pool.terminate()
        pool.join()


_shapes: dict[str, coal.CollisionGeometry] = {}
"""The shapes in a process that makes covers; being forked, it has them without a copy."""


def _start(shapes: Mapping[str, coal.CollisionGeometry]) -> None:
    """Keep the shapes, and leave Ctrl-C, which reaches all processes of a terminal, to the one that ends the others."""
    _shapes.update(shapes)
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _make(job: tuple[str, int]) -> tuple[str, Cover]:
    key, effort = job
    return key, make_cover(_shapes[key], effort=effort)


def _until(deadline: float, results: Any) -> Iterator[tuple[str, Cover]]:
    while True:
        left = deadline - time.monotonic()
        try:
            yield results.next(None if left == np.inf else max(left, 0.0))
        except (StopIteration, multiprocessing.TimeoutError):
            return


def _weights(path: Path, robot: Robot) -> dict[str, float]:
    """Return shape key -> share of free states at which it is part of a pair that is not proved apart."""
    now = build_robot(read_config(path), path)
    checker = CollisionChecker(now)
    states = now.random_state(np.random.default_rng(0), SAMPLES)
    _, spoilers = proved_share(checker, states[checker.are_free(states)])
    weights: dict[str, float] = {}
    for item in robot.geometry.geometryObjects:
        link = link_of(robot.model, item)
        share = sum(value for links, value in spoilers.items() if link in links)
        weights[shape_key(item.geometry)] = weights.get(shape_key(item.geometry), 0.0) + share
    return weights


def name_in(path: Path, files: Mapping[str, Path]) -> None:
    """Add lines to a robot file that name files beside it, where it does not name them; the rest stays as it is."""
    config = read_config(path)
    lines = [f"{key}: {file.name}" for key, file in files.items() if getattr(config, key) is None]
    if lines:
        text = read_text(path, "robot file")
        write_atomically(path, (text.rstrip("\n") + "\n" + "\n".join(lines) + "\n").encode())
