"""Data engine: solves each problem by several methods and keeps the valid paths. It needs the kernel alone.

A :class:`PathFinder` finds paths for one problem by trees and by optimization; an :class:`Engine` solves the problems
of a unit of work. Problems are drawn, and solved with meshes, by :mod:`apex_ompl.training.units`.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.search import ENOUGH, RESOLUTION, TreePair, shortcut
from apex_ompl.model.geometry import ObstacleRecord
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.spline import Spline
from apex_ompl.training.records import FIELDS, SOURCES, Paths, to_half, to_micro
from apex_ompl.types import Array
from apex_ompl.util.resolution import FINE_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.util.stopwatch import timed

FEW, MANY = 1, 8  # initial paths that are optimized together
PERTURBATION_SIZES = (0.4, 1.2)  # range of the size of random perturbations [rad]
PART_STEPS = 12  # optimizer steps for a part of a path
COMPARED_STATES = 12  # number of states at which two paths are compared
CLEARANCE_RANGE = 0.2  # clearances are measured up to here [m]
TREE_RANGE = 1.0  # longest step of trees [rad]
TREE_ITERATIONS = 30_000  # of trees, at most
STRAIGHT_SHARE = 0.2  # largest share of the kept problems that the straight line solves
PART_LENGTHS = (0.25, 0.9)  # range of the length of a part of a path, as a share of its states
RESTS = 0.5  # share of the parts that end where their path ends
DUPLICATE_DISTANCE = 0.1  # a path nearer to another one is not kept [rad, max-norm]
STRATEGIES = {
    "open": (("perturbation", "perturbation"), ("rrtconnect", "many perturbations")),
    "broad": (("rrtconnect", "rrtconnect"), ("many perturbations", "rrtconnect")),
    "easy": (("rrtconnect", "rrtconnect"), ("many perturbations", "rrtconnect")),
    "medium": (("rrtconnect", "rrtconnect"), ("many perturbations", "rrtconnect")),
    "hard": (("rrtconnect", "rrtconnect"), ("many perturbations", "rrtconnect")),
    "extreme": (("rrtconnect", "rrtconnect"), ("many perturbations", "rrtconnect")),
}
"""Search methods in two groups, for the levels of the hard suites, for open scenes and for broad ones. The first group
is tried in turn; where it finds no path, the second is tried until one does. Chosen by the yield of each method."""


class PathFinder:
    """Finds paths for one problem; a path is valid where the sphere cover proves it free of collisions.

    Attributes:
        kernel: The robot among its obstacles.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        optimizer: Optimizer of the paths' splines.
        iterations: Of trees, at most.
        points: Obstacle points nearest to the robot, shape (3,) [m], by the bytes of the state.
        proposer: Returns proposals of a model, control points of shape (count, points, dof), for a count and a seed;
            None where there is no model.
    """

    proposer: Callable[[int, int], Array] | None = None

    def __init__(self, kernel: Kernel, start: Array, goal: Array, optimizer: Optimizer) -> None:
        """Find paths from ``start`` to ``goal``, shape (dof,) [rad]."""
        self.kernel, self.start, self.goal, self.optimizer = kernel, start, goal, optimizer
        self.lower, self.upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
        self.iterations = TREE_ITERATIONS
        self.points: dict[bytes, Array] = {}

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check."""
        inside = bool((states >= self.lower).all() and (states <= self.upper).all())
        return inside and self.proves(states)

    def proves(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), inside of the limits is proved free."""
        return self.kernel.proves(states, FINE_RESOLUTION)

    def is_free(self, line: Array) -> bool:
        """Whether a straight motion, shape (2, dof), is free at the resolution that planners search with."""
        return self.kernel.proves(line, SEARCH_RESOLUTION)

    def search(self, seed: int) -> Array | None:
        """Return the control points of a spline fitted to a path of RRT-Connect that is cut short, or None."""
        rng = np.random.default_rng(seed)
        ends = self.start[None], self.goal[None]
        states = TreePair(self.kernel, *ends, TREE_RANGE, SEARCH_RESOLUTION, rng).grow(self.iterations)
        if states is None:
            return None
        path, _ = shortcut(self.kernel, states, ENOUGH, RESOLUTION, rng)
        return self.optimizer.spline.fit(path, self.lower, self.upper).control

    def optimize_proposals(self, seed: int) -> Array | None:
        """Return the control points of a valid path, optimized from a model's proposals, or None."""
        if self.proposer is None:
            return None
        return first_valid(self.optimizer, self.kernel, self.proposer(MANY, seed), self.is_valid)

    def obstacle_point(self, q: Array) -> Array | None:
        """Return the obstacle point nearest to the robot at a state, shape (3,) [m], or None where it is unknown."""
        return self.points.get(q.tobytes())

    def optimize_perturbations(self, rng: np.random.Generator, *, line: bool, many: bool) -> Array | None:
        """Return the control points of a valid path, optimized from perturbed straight lines, or None.

        Args:
            rng: Source of the perturbations.
            line: Whether the straight line itself is the first initial path.
            many: Whether to optimize many initial paths at once, instead of few and then more.
        """
        start, goal, size = self.start, self.goal, float(rng.uniform(*PERTURBATION_SIZES))
        counts = (4 * MANY,) if many else (FEW, MANY)
        for count in counts:
            starts = self.optimizer.starts(start, goal, count + 1, rng, size)
            found = first_valid(self.optimizer, self.kernel, starts[:count] if line else starts[1:], self.is_valid)
            if found is not None:
                return found
        return None

    def shorten(self, control: Array) -> Array | None:
        """Return the control points of the shortest valid path found by shortening a path, or None."""
        return self.optimizer.shorten(self.kernel, control, self.is_valid)

    def quantize(self, control: Array) -> Array | None:
        """Return control points in the precision of the store, or None where the path then fails the full check."""
        inner = self.optimizer.spline.inner
        stored = np.clip(control, self.lower, self.upper)
        stored[inner] = to_half(stored[inner], self.lower, self.upper)
        stored[0], stored[-1] = np.round(control[0], 6), np.round(control[-1], 6)
        stored = self.optimizer.spline.with_ends(stored, stored[0], stored[-1])
        return stored if self.is_valid(self.optimizer.spline.path(stored)) else None

    def part(self, control: Array, first: int, last: int) -> Array | None:
        """Return the control points of a path's part from state ``first`` to state ``last``.

        None where the straight line between these is valid, or where the fitted part is not.
        """
        spline = self.optimizer.spline
        states = spline.path(control)[first : last + 1].copy()
        states[[0, -1]] = np.round(states[[0, -1]], 6)
        if self.is_valid(states[[0, -1]]):
            return None
        fitted = spline.fit(states, self.lower, self.upper).control
        stored = self.quantize(fitted)
        if stored is None:
            stored = self.quantize(self.optimizer.improve(self.kernel, fitted[None], steps=PART_STEPS).control[0])
        return stored

    def homotopy_classes(self, paths: Sequence[Array]) -> list[int]:
        """Return the class of each path, numbered from 0; paths of one class can be deformed into each other.

        Two paths can be deformed into each other when the straight motions between their states at equal parameters are
        free (visibility deformation, Jaillet and Simeon 2008), here at some parameters.
        """
        spline = self.optimizer.spline
        found: list[int] = []
        where = np.linspace(0, spline.states - 1, COMPARED_STATES + 2).astype(int)[1:-1]
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
        """Return the smallest clearance of the sphere cover along a path, at every other state from the first [m]."""
        return float(self.kernel.clearance(states[::2], CLEARANCE_RANGE).min())


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
            source = "perturbation" if method == "many perturbations" else method
            with self.timed(source):
                if source == "perturbation":
                    control = finder.optimize_perturbations(rng, line=k == 0, many=method == "many perturbations")
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
