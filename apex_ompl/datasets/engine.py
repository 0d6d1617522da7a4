"""The data engine: a problem solved in several ways, and what was proved kept. It needs the kernel alone.

What draws problems, and what asks OMPL and the meshes, builds on it: :mod:`apex_ompl.generation.worker`.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from apex_ompl.datasets.records import FIELDS, SOURCES, Paths, rounded, to_micro
from apex_ompl.kernel import Kernel
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.trajopt.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.resolution import FULL_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.util.stopwatch import timed

STRAIGHT_SHARE = 0.2  # of the problems that are kept, those that the straight line solves
FEW, MANY, BUMP_SIZE = 1, 8, (0.4, 1.2)  # paths from bumps at once, and how far they stray [rad]
PART = (0.1, 0.6)  # where parts begin, as a share of a path's states
PART_STEPS = 12
SAME = 0.1  # paths nearer to each other than this are one [rad, max-norm]
BETWEEN = 12  # states at which two paths are compared
RECIPES = {
    "open": (("bumps", "bumps"), ("rrtconnect", "many bumps")),
    "easy": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
    "medium": (("rrtconnect", "rrtconnect"), ("many bumps", "rrtconnect")),
    "hard": (("rrtconnect", "bumps"), ("many bumps", "rrtconnect")),
}
"""How paths are sought, by what yields most, on levels of the hard suites and in open scenes: by these ways in turn,
and where none of them worked by those behind, until one does."""


@dataclass(frozen=True)
class Options:
    """How problems are solved.

    Attributes:
        seed: Seed of all random choices but the problems themselves.
        copies: How many paths of different origin are sought for each problem.
        parts: How many parts of each of them, from a state on the way to the goal.
        model: Name or folder of a model whose proposals are tried before all else; none by default.
    """

    seed: int = 0
    copies: int = 2
    parts: int = 2
    model: str = ""


@dataclass(frozen=True)
class Row:
    """What is written of a problem, besides its paths.

    Attributes:
        seed: Its seed.
        held: What the hands hold, as JSON.
        things: Number of the shape, position, orientation and size of each obstacle, see ``apex_ompl.datasets.store``.
    """

    seed: int
    held: str
    things: Sequence[tuple[int, Sequence[float], Sequence[float], Sequence[float]]]


class Case:
    """A problem as the kernel knows it: paths are valid when the spheres prove them.

    Attributes:
        points: Obstacle points nearest to the robot, shape (3,) [m], by the bytes of the state.
        proposer: Gives a number of proposals, control points of shape (B, points, dof), by a seed; where there is one.
    """

    proposer: Callable[[int, int], Array] | None = None

    def __init__(self, kernel: Kernel, start: Array, goal: Array, optimizer: Optimizer) -> None:
        """Go from ``start`` to ``goal``, shape (dof,)."""
        self.kernel, self.start, self.goal, self.optimizer = kernel, start, goal, optimizer
        self.lower, self.upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
        self.points: dict[bytes, Array] = {}

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check."""
        inside = bool((states >= self.lower).all() and (states <= self.upper).all())
        return inside and self.kernel.proves(states, FULL_RESOLUTION)

    def is_free(self, line: Array) -> bool:
        """Whether a straight motion, shape (2, dof), is free at the resolution that planners search with."""
        return self.kernel.proves(line, SEARCH_RESOLUTION)

    def searched(self, seed: int) -> Array | None:
        """Return control points near a path that a planner found, or None; here there is no planner."""
        del seed
        return None

    def proposed(self, seed: int) -> Array | None:
        """Return a clear path from proposals of a model, or None."""
        if self.proposer is None:
            return None
        return first_valid(self.optimizer, self.kernel, self.proposer(MANY, seed), self.is_valid)

    def point(self, q: Array) -> Array | None:
        """Return the obstacle point nearest to the robot at a state, shape (3,) [m], where it is known."""
        return self.points.get(q.tobytes())

    def bumped(self, rng: np.random.Generator, line: bool, many: bool) -> Array | None:
        """Return a clear path from the straight line, or else from bumps; from more of them where ``many``."""
        start, goal, size = self.start, self.goal, float(rng.uniform(*BUMP_SIZE))
        counts = (4 * MANY,) if many else (FEW, MANY)
        for count in counts:
            starts = self.optimizer.starts(start, goal, count + 1, rng, size)
            found = first_valid(self.optimizer, self.kernel, starts[:count] if line else starts[1:], self.is_valid)
            if found is not None:
                return found
        return None

    def shortened(self, control: Array) -> Array | None:
        """Return the shortest valid path that comes out of one, or None."""
        return self.optimizer.shorten(self.kernel, control, self.is_valid)

    def proven(self, control: Array) -> Array | None:
        """Return control points as they will be stored, or None when they fail the full check."""
        inner = self.optimizer.spline.inner
        stored = np.clip(control, self.lower, self.upper)
        stored[inner] = rounded(stored[inner], self.lower, self.upper)
        stored[0], stored[-1] = np.round(control[0], 6), np.round(control[-1], 6)
        stored = self.optimizer.spline.with_ends(stored, stored[0], stored[-1])
        return stored if self.is_valid(self.optimizer.spline.path(stored)) else None

    def part(self, control: Array, first: int) -> Array | None:
        """Return the rest of a path from one of its states, unless a straight line does it."""
        spline = self.optimizer.spline
        states = spline.path(control)[first:].copy()
        states[0] = np.round(states[0], 6)
        if self.is_valid(states[[0, -1]]):
            return None
        fitted = spline.fit(states, self.lower, self.upper).control
        proven = self.proven(fitted)
        if proven is None:
            proven = self.proven(self.optimizer.improve(self.kernel, fitted[None], steps=PART_STEPS).control[0])
        return proven

    def classes(self, paths: Sequence[Array]) -> list[int]:
        """Return a number for each path; those that can be deformed into each other along lines share one.

        Two paths can when the lines between their states at the same parameter are free (the visibility deformation of
        Jaillet and Simeon 2008, at some parameters).
        """
        spline = self.optimizer.spline
        found: list[int] = []
        where = np.linspace(0, spline.states - 1, BETWEEN + 2).astype(int)[1:-1]
        states = [spline.path(control)[where] for control in paths]
        for k, mine in enumerate(states):
            for other, number in zip(states[:k], found, strict=True):
                lines = (np.stack(pair) for pair in zip(mine, other, strict=True))
                if all(self.is_free(line) for line in lines):
                    found.append(number)
                    break
            else:
                found.append(max(found, default=-1) + 1)
        return found

    def clearance(self, states: Array) -> float:
        """Return the clearance of the sphere cover along a path, at every other of its states from the first [m]."""
        return float(self.kernel.clearance(states[::2], 0.2).min())


def _apart(spline: Spline, a: Array, b: Array) -> float:
    """Return how far two paths are apart at the same parameter [rad, max-norm]."""
    return float(np.abs(spline.path(a) - spline.path(b)).max())


class Engine:
    """Solves the problems of a unit of work one by one.

    Attributes:
        counts: What was tried, and what came of it.
        times: Where the time went [s].
    """

    def __init__(self, unit: str, names: tuple[str, str], recipe: str, options: Options, spline: Spline) -> None:
        """Solve problems of a suite and level, ``names``, by a recipe; the unit's name goes into the seeds."""
        first, second = RECIPES[recipe]
        self._recipe = (("model",), (*first, *second)) if options.model else (first, second)
        self._unit, self._names, self._options = unit, names, options
        self.optimizer = Optimizer(spline)
        self.counts: Counter[str] = Counter()
        self.times: dict[str, float] = {}
        self._rows: dict[str, list[Any]] = {name: [] for name in FIELDS}
        self._held: list[str] = []
        self._unsolved: list[int] = []

    def solve(self, task: Case, row: Row) -> None:
        """Solve a problem, and keep the paths."""
        spline = self.optimizer.spline
        self.counts["drawn"] += 1
        ends = task.start, task.goal
        with self.timed("check"):
            straight = task.is_valid(np.stack(ends))
        if straight:
            if self.counts["straight"] + 1 > STRAIGHT_SHARE * (self.counts["solved"] + 1):
                self.counts["straight, left out"] += 1
                return
            self.counts["straight"] += 1
        found = [("line", spline.line(*ends))] if straight else self._sought(task, row.seed)
        kept: list[tuple[str, Array]] = []
        for source, control in found:
            with self.timed("check"):
                proven = task.proven(control)
                if proven is None or any(_apart(spline, proven, other) < SAME for _, other in kept):
                    self.counts["not kept"] += 1
                    continue
            kept.append((source, proven))
        if not kept:
            self._unsolved.append(row.seed)
            return
        self.counts["solved"] += 1
        number = self._add_problem(row)
        self._keep(task, number, kept)

    def _sought(self, task: Case, seed: int) -> Iterator[tuple[str, Array]]:
        """Find paths, see :data:`RECIPES`."""
        rng = np.random.default_rng([zlib.crc32(self._unit.encode()), self._options.seed, seed])
        first, second = self._recipe
        rounds = self._options.copies // len(first) + 1
        found = 0
        for k, way in enumerate((*(first * rounds)[: self._options.copies], *second)):
            if k >= self._options.copies and found:
                return
            source = "bumps" if way == "many bumps" else way
            with self.timed(source):
                if source == "bumps":
                    control = task.bumped(rng, line=k == 0, many=way == "many bumps")
                else:
                    seek = task.proposed if source == "model" else task.searched
                    control = seek(int(rng.integers(2**31 - 1)))
            if control is None:
                continue
            with self.timed("shorten"):
                control = task.shortened(control)
            if control is not None:
                found += 1
                yield source, control

    def _keep(self, task: Case, number: int, kept: list[tuple[str, Array]]) -> None:
        """Keep paths, their reversals, and parts of both."""
        rng = np.random.default_rng([zlib.crc32(self._unit.encode()), self._options.seed, number, 1])
        with self.timed("homotopy"):
            classes = task.classes([control for _, control in kept])
        for (source, control), homotopy in zip(kept, classes, strict=True):
            with self.timed("check"):
                backwards = task.proven(control[::-1])
            self._add_path(task, number, source, control, homotopy)
            if backwards is not None:
                self._add_path(task, number, "reversed", backwards, homotopy)
            if source == "line":
                continue
            for whole in (control,) if backwards is None else (control, backwards):
                for _ in range(self._options.parts):
                    with self.timed("parts"):
                        part = task.part(whole, int(rng.integers(*(np.array(PART) * self.optimizer.spline.states))))
                    if part is not None:
                        self._add_path(task, number, "part", part, homotopy)

    def _add_problem(self, row: Row) -> int:
        rows, number = self._rows, len(self._rows["seed"])
        if row.held not in self._held:
            self._held.append(row.held)
        values = {"seed": row.seed, "suite": 0, "level": 0, "held": self._held.index(row.held)}
        for key, value in {**values, "things": len(row.things)}.items():
            rows[key].append(value)
        for thing in row.things:
            for name, numbers in zip(("shape", "position", "orientation", "size"), thing, strict=True):
                rows[name].append(numbers)
        return number

    def _add_path(self, task: Case, number: int, source: str, control: Array, homotopy: int) -> None:
        spline = self.optimizer.spline
        states = spline.path(control)
        with self.timed("point"):
            point = task.point(control[0])
        if point is None:
            self.counts["no point"] += 1
            return
        length = float(np.linalg.norm(np.diff(states, axis=0), axis=1).sum())
        values = {
            "problem": number, "start": to_micro(control[0]), "goal": to_micro(control[-1]),
            "control": control[spline.inner], "point": point, "clearance": task.clearance(states),
            "length": length,
            "source": SOURCES.index(source), "homotopy": homotopy,
        }  # fmt: skip
        for key, value in values.items():
            self._rows[key].append(value)

    def paths(self, robot: str, joints: Sequence[str]) -> Paths:
        """Return what was kept, of a robot by its name and planned joints."""
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
        """Count the time of a block to a stage."""
        return timed(self.times, stage)
