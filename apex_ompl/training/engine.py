"""Data engine: solves each problem by several methods and keeps the valid paths. It needs the kernel alone.

Problems are drawn, and solved with meshes, by :mod:`apex_ompl.training.problem_solving`.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from apex_ompl.model.geometry import ObstacleRecord
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.spline import Spline
from apex_ompl.training.path_finder import PathFinder
from apex_ompl.training.records import FIELDS, SOURCES, Paths, to_micro
from apex_ompl.types import Array
from apex_ompl.util.clocks import timed

STRAIGHT_SHARE = 0.2  # largest share of the kept problems that the straight line solves
PART_LENGTHS = (0.25, 0.9)  # range of the length of a part of a path, as a share of its states
RESTS = 0.5  # share of the parts that end where their path does
DUPLICATE_DISTANCE = 0.1  # a path nearer to another one is not kept [rad, max-norm]
STRATEGIES = {
    "open": (("bumps", "bumps"), ("rrtconnect", "many bumps")),
    "broad": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
    "easy": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
    "medium": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
    "hard": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
    "extreme": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
}
"""Methods by which paths are searched, for the levels of the hard suites, for open scenes and for broad ones: the first
ones in turn, and, where none finds a path, the second ones until one does. Chosen by the yield of each method."""


@dataclass(frozen=True)
class EngineOptions:
    """Options of the data engine.

    Attributes:
        seed: Seed of all random choices but the problems themselves.
        copies: Number of searches for each problem.
        parts: Number of parts that are tried of each path, between two of its states.
        model: Name or folder of a model whose proposals are tried first; none by default.
    """

    seed: int = 0
    copies: int = 2
    parts: int = 2
    model: str = ""


@dataclass(frozen=True)
class ProblemRecord:
    """Record of a problem in a data set.

    Attributes:
        seed: Seed of the problem.
        held: Held objects, as JSON.
        obstacles: The obstacles.
    """

    seed: int
    held: str
    obstacles: Sequence[ObstacleRecord]


class Engine:
    """Solves the problems of a unit of work one by one.

    Attributes:
        optimizer: Optimizer of the paths' splines.
        counts: Statistics of the generation, by name.
        times: Time by stage [s].
    """

    def __init__(
        self, unit: str, names: tuple[str, str], strategy: str, options: EngineOptions, spline: Spline
    ) -> None:
        """Solve the problems of a unit of work.

        Args:
            unit: Name of the unit, which goes into the seeds.
            names: Suite and level of the problems.
            strategy: Key of :data:`STRATEGIES`.
            options: Options of the engine.
            spline: Spline of the paths.
        """
        first, second = STRATEGIES[strategy]
        self._methods = (("model",), (*first, *second)) if options.model else (first, second)
        self._unit, self._names, self._options = unit, names, options
        self.optimizer = Optimizer(spline)
        self.counts: Counter[str] = Counter()
        self.times: dict[str, float] = {}
        self._rows: dict[str, list[Any]] = {name: [] for name in FIELDS}
        self._held: list[str] = []
        self._unsolved: list[int] = []

    def solve(self, finder: PathFinder, record: ProblemRecord) -> None:
        """Solve a problem, and keep the valid paths."""
        spline = self.optimizer.spline
        self.counts["drawn"] += 1
        ends = finder.start, finder.goal
        with self.timed("check"):
            straight = finder.is_valid(np.stack(ends))
        if straight:
            if self.counts["straight"] + 1 > STRAIGHT_SHARE * (self.counts["solved"] + 1):
                self.counts["straight, left out"] += 1
                return
            self.counts["straight"] += 1
        found = [("line", spline.line(*ends))] if straight else self._search(finder, record.seed)
        kept: list[tuple[str, Array]] = []
        for source, control in found:
            with self.timed("check"):
                stored = finder.quantize(control)
                if stored is None or any(_distance(spline, stored, other) < DUPLICATE_DISTANCE for _, other in kept):
                    self.counts["not kept"] += 1
                    continue
            kept.append((source, stored))
        if not kept:
            self._unsolved.append(record.seed)
            return
        self.counts["solved"] += 1
        number = self._add_problem(record)
        self._keep(finder, number, kept)

    def _search(self, finder: PathFinder, seed: int) -> Iterator[tuple[str, Array]]:
        """Yield source and control points of valid paths, see :data:`STRATEGIES`."""
        rng = np.random.default_rng([zlib.crc32(self._unit.encode()), self._options.seed, seed])
        first, second = self._methods
        rounds = self._options.copies // len(first) + 1
        found = 0
        for k, method in enumerate((*(first * rounds)[: self._options.copies], *second)):
            if k >= self._options.copies and found:
                return
            source = "bumps" if method == "many bumps" else method
            with self.timed(source):
                if source == "bumps":
                    control = finder.optimize_bumps(rng, line=k == 0, many=method == "many bumps")
                else:
                    search = finder.optimize_proposals if source == "model" else finder.search
                    control = search(int(rng.integers(2**31 - 1)))
            if control is None:
                continue
            with self.timed("shorten"):
                control = finder.shorten(control)
            if control is not None:
                found += 1
                yield source, control

    def _keep(self, finder: PathFinder, number: int, kept: list[tuple[str, Array]]) -> None:
        """Keep paths, their reversals, and parts of both."""
        rng = np.random.default_rng([zlib.crc32(self._unit.encode()), self._options.seed, number, 1])
        with self.timed("homotopy"):
            classes = finder.homotopy_classes([control for _, control in kept])
        for (source, control), homotopy in zip(kept, classes, strict=True):
            with self.timed("check"):
                backwards = finder.quantize(control[::-1])
            self._add_path(finder, number, source, control, homotopy)
            if backwards is not None:
                self._add_path(finder, number, "reversed", backwards, homotopy)
            if source == "line":
                continue
            for path in (control,) if backwards is None else (control, backwards):
                for _ in range(self._options.parts):
                    with self.timed("parts"):
                        part = finder.part(path, *_part_ends(rng, self.optimizer.spline.states))
                    if part is not None:
                        self._add_path(finder, number, "part", part, homotopy)

    def _add_problem(self, record: ProblemRecord) -> int:
        rows, number = self._rows, len(self._rows["seed"])
        if record.held not in self._held:
            self._held.append(record.held)
        values = {"seed": record.seed, "suite": 0, "level": 0, "held": self._held.index(record.held)}
        for key, value in {**values, "things": len(record.obstacles)}.items():
            rows[key].append(value)
        for obstacle in record.obstacles:
            for name, numbers in zip(("shape", "position", "orientation", "size"), obstacle, strict=True):
                rows[name].append(numbers)
        return number

    def _add_path(self, finder: PathFinder, number: int, source: str, control: Array, homotopy: int) -> None:
        spline = self.optimizer.spline
        states = spline.path(control)
        with self.timed("point"):
            point = finder.obstacle_point(control[0])
        if point is None:
            self.counts["no point"] += 1
            return
        length = float(np.linalg.norm(np.diff(states, axis=0), axis=1).sum())
        values = {
            "problem": number, "start": to_micro(control[0]), "goal": to_micro(control[-1]),
            "control": control[spline.inner], "point": point, "clearance": finder.clearance(states),
            "length": length,
            "source": SOURCES.index(source), "homotopy": homotopy,
        }  # fmt: skip
        for key, value in values.items():
            self._rows[key].append(value)

    def paths(self, robot: str, joints: Sequence[str]) -> Paths:
        """Return the kept paths, of a robot by its name and planned joints."""
        dof, free = len(joints), self.optimizer.spline.free
        shapes = {"start": (dof,), "goal": (dof,), "control": (free, dof)}
        arrays = {
            name: np.array(self._rows[name], kind).reshape(-1, *shapes.get(name, shape))
            for name, (kind, shape) in FIELDS.items()
        }
        names = {"suite": self._names[:1], "level": self._names[1:], "held": tuple(self._held)}
        about = {"robot": robot, "joints": list(joints), **asdict(self.optimizer.spline)}
        return Paths(arrays, names, about, {**self.counts, "unsolved": self._unsolved})

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Add the time of a block to a stage."""
        return timed(self.times, stage)


def _part_ends(rng: np.random.Generator, states: int) -> tuple[int, int]:
    """Draw the first and the last state of a part of a path."""
    length = int(rng.uniform(*PART_LENGTHS) * states)
    first = states - 1 - length if rng.random() < RESTS else int(rng.integers(states - length))
    return first, first + length


def _distance(spline: Spline, a: Array, b: Array) -> float:
    """Return the largest distance of two paths at equal parameters [rad, max-norm]."""
    return float(np.abs(spline.path(a) - spline.path(b)).max())
