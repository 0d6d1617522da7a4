"""The data engine: problems drawn, solved in several ways, and what was proved kept."""

from __future__ import annotations

import json
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og

from apex_ompl import problems
from apex_ompl.assembly import PlanningSetup, assemble
from apex_ompl.dataset import FIELDS, SHAPES, SOURCES, Paths, to_micro
from apex_ompl.errors import UnknownNameError
from apex_ompl.ompl_globals import quiet_ompl, seed_ompl
from apex_ompl.optimize import Optimizer
from apex_ompl.problem import Obstacle, Problem
from apex_ompl.problems import scenes
from apex_ompl.problems.catalogue import KNOWN, SPLITS, SuiteError
from apex_ompl.problems.reach import robot
from apex_ompl.simplify import simplify
from apex_ompl.space import SEARCH_RESOLUTION, path_length, path_to_array
from apex_ompl.spline import Spline
from apex_ompl.validity import full_check

Array = NDArray[np.float64]

UNIT = 16  # problems in a unit of work
STRAIGHT_SHARE = 0.2  # of the problems that are kept, those that the straight line solves
NO_POINT = (0.0, 0.0, -1.0)
"""The obstacle point where there is no obstacle: a metre under the tables' surface, further than any obstacle [m]."""

FEW, MANY, BUMP_SIZE = 1, 8, (0.4, 1.2)  # paths from bumps at once, and how far they stray [rad]
MOST_ITERATIONS = 30_000  # of rrtconnect
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
class Unit:
    """Problems that are solved together, and whose paths are written together.

    Attributes:
        suite: A suite, or ``broad``.
        level: One of its levels.
        number: Counts the units of a level from 0.
        size: Number of problems that are drawn.
    """

    suite: str
    level: str
    number: int
    size: int = UNIT

    @property
    def name(self) -> str:
        """Name of the unit, for example ``shelf-hard-00012``."""
        return f"{self.suite}-{self.level}-{self.number:05d}"

    @property
    def seeds(self) -> range:
        """Seeds of its problems, of the training split."""
        return range(self.number * self.size, (self.number + 1) * self.size)


@dataclass(frozen=True)
class Options:
    """How problems are solved.

    Attributes:
        seed: Seed of all random choices but the problems themselves.
        copies: How many paths of different origin are sought for each problem.
        parts: How many parts of each of them, from a state on the way to the goal.
    """

    seed: int = 0
    copies: int = 2
    parts: int = 2


SHARES = {"broad": 6.0, "vertical": 1.2, "horizontal": 1.2, "easy": 1.0, "medium": 0.8, "hard": 0.4}
"""How many problems are drawn of each level of a suite, or of a level of the hard suites, relative to others: fewer where
one takes longer."""


def static_levels() -> list[tuple[str, str]]:
    """Return all suites and levels without moving obstacles, and the broad generator's."""
    return [(s, level) for s, levels in KNOWN.items() for level in levels if not level.startswith("moving-")]


def plan_units(count: int, only: Sequence[str] = ()) -> list[Unit]:
    """Return units of about ``count`` problems over all static suites and levels, the levels in turn.

    Args:
        count: How many problems to draw.
        only: Suites, or ``suite/level``; none means all.

    Raises:
        UnknownNameError: No such suite or level.
    """
    known = static_levels()
    for name in only:
        if name not in {s for s, _ in known} | {f"{s}/{level}" for s, level in known}:
            raise UnknownNameError("static suite or level", name, [f"{s}/{level}" for s, level in known])
    chosen = [(s, v) for s, v in known if not only or s in only or f"{s}/{v}" in only]
    weights = [SHARES[s if s in SHARES else v] for s, v in chosen]
    found = [
        (k / weight, place, Unit(s, v, k))
        for place, ((s, v), weight) in enumerate(zip(chosen, weights, strict=True))
        for k in range(max(1, round(count * weight / sum(weights) / UNIT)))
        if (k + 1) * UNIT <= SPLITS["train"].stop
    ]
    return [unit for *_, unit in sorted(found, key=lambda row: row[:2])]


def work(unit: Unit, options: Options, spline: Spline) -> tuple[Paths, dict[str, float]]:
    """Draw and solve the problems of a unit; the same arguments give the same paths.

    Returns:
        The paths, and where the time went [s].
    """
    engine = _Engine(unit, options, spline)
    with quiet_ompl():
        for seed in unit.seeds:
            engine.solve(seed)
    return engine.paths(), engine.times


class _Engine:
    """Solves the problems of a unit one by one."""

    def __init__(self, unit: Unit, options: Options, spline: Spline) -> None:
        self.unit, self.options = unit, options
        self.optimizer = Optimizer(spline)
        self.counts: Counter[str] = Counter()
        self.times: dict[str, float] = {}
        self.rows: dict[str, list[Any]] = {name: [] for name in FIELDS}
        self.held: list[str] = []
        self.unsolved: list[int] = []

    def solve(self, seed: int) -> None:
        """Draw and solve a problem, and keep the paths."""
        unit, spline = self.unit, self.optimizer.spline
        name = f"{unit.suite}/{unit.level}/{seed}"
        with self._timed("draw"):
            try:
                problem = problems.load(name)
            except SuiteError:
                self.counts["not drawn"] += 1
                return
            task = _Task(assemble(problem, robot()), self.optimizer)
        self.counts["drawn"] += 1
        ends = task.ready.start, task.ready.goals[0]
        with self._timed("check"):
            straight = task.is_valid(np.stack(ends))
        if straight:
            if self.counts["straight"] + 1 > STRAIGHT_SHARE * (self.counts["solved"] + 1):
                self.counts["straight, left out"] += 1
                return
            self.counts["straight"] += 1
        found = [("line", spline.line(*ends))] if straight else self._sought(task, seed)
        kept: list[tuple[str, Array]] = []
        for source, control in found:
            with self._timed("check"):
                proven = task.proven(control)
                if proven is None or any(_apart(spline, proven, other) < SAME for _, other in kept):
                    self.counts["not kept"] += 1
                    continue
            kept.append((source, proven))
        if not kept:
            self.unsolved.append(seed)
            return
        self.counts["solved"] += 1
        number = self._add_problem(problem, seed)
        self._keep(task, number, kept)

    def _sought(self, task: _Task, seed: int) -> Iterator[tuple[str, Array]]:
        """Find paths, see :data:`RECIPES`."""
        rng = np.random.default_rng([zlib.crc32(self.unit.name.encode()), self.options.seed, seed])
        first, second = RECIPES.get(self.unit.level if self.unit.suite in scenes.SUITES else "", RECIPES["open"])
        rounds = self.options.copies // len(first) + 1
        found = 0
        for k, way in enumerate((*(first * rounds)[: self.options.copies], *second)):
            if k >= self.options.copies and found:
                return
            source = "rrtconnect" if way == "rrtconnect" else "bumps"
            with self._timed(source):
                if source == "bumps":
                    control = task.bumped(rng, line=k == 0, many=way == "many bumps")
                else:
                    control = task.searched(int(rng.integers(2**31 - 1)))
            if control is None:
                continue
            with self._timed("shorten"):
                control = task.shortened(control)
            if control is not None:
                found += 1
                yield source, control

    def _keep(self, task: _Task, number: int, kept: list[tuple[str, Array]]) -> None:
        """Keep paths, their reversals, and parts of both."""
        rng = np.random.default_rng([zlib.crc32(self.unit.name.encode()), self.options.seed, number, 1])
        with self._timed("homotopy"):
            classes = task.classes([control for _, control in kept])
        for (source, control), homotopy in zip(kept, classes, strict=True):
            with self._timed("check"):
                backwards = task.proven(control[::-1])
            self._add_path(task, number, source, control, homotopy)
            if backwards is not None:
                self._add_path(task, number, "reversed", backwards, homotopy)
            if source == "line":
                continue
            for whole in (control,) if backwards is None else (control, backwards):
                for _ in range(self.options.parts):
                    with self._timed("parts"):
                        part = task.part(whole, int(rng.integers(*(np.array(PART) * self.optimizer.spline.states))))
                    if part is not None:
                        self._add_path(task, number, "part", part, homotopy)

    def _add_problem(self, problem: Problem, seed: int) -> int:
        rows, number = self.rows, len(self.rows["seed"])
        held = json.dumps([h.model_dump(mode="json", exclude_defaults=True) for h in problem.attached])
        if held not in self.held:
            self.held.append(held)
        for key, number_of in {"seed": seed, "suite": 0, "level": 0, "held": self.held.index(held)}.items():
            rows[key].append(number_of)
        rows["things"].append(len(problem.scene))
        for thing in problem.scene:
            for key, value in zip(("shape", "position", "orientation", "size"), _thing(thing), strict=True):
                rows[key].append(value)
        return number

    def _add_path(self, task: _Task, number: int, source: str, control: Array, homotopy: int) -> None:
        spline = self.optimizer.spline
        states = spline.path(control)
        with self._timed("point"):
            point = task.point(control[0])
        values = {
            "problem": number, "start": to_micro(control[0]), "goal": to_micro(control[-1]),
            "control": control[spline.inner], "point": point, "clearance": task.clearance(states),
            "length": path_length(states), "source": SOURCES.index(source), "homotopy": homotopy,
        }  # fmt: skip
        for key, value in values.items():
            self.rows[key].append(value)

    def paths(self) -> Paths:
        """Return what was kept."""
        dof, free = robot().dof, self.optimizer.spline.free
        shapes = {"start": (dof,), "goal": (dof,), "control": (free, dof)}
        arrays = {
            name: np.array(self.rows[name], kind).reshape(-1, *shapes.get(name, shape))
            for name, (kind, shape) in FIELDS.items()
        }
        names = {"suite": (self.unit.suite,), "level": (self.unit.level,), "held": tuple(self.held)}
        return Paths(arrays, names, {**self.counts, "unsolved": self.unsolved})

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.times[stage] = self.times.get(stage, 0.0) + time.perf_counter() - begin


class _Task:
    """One problem, made ready."""

    def __init__(self, ready: PlanningSetup, optimizer: Optimizer) -> None:
        self.ready, self.optimizer = ready, optimizer
        self.verdict, self.kernel, self.limits = ready.verdict, ready.verdict.kernel, ready.robot.limits
        self._setup = ready.simple_setup
        self._points: dict[bytes, Array] = {}

    def is_valid(self, states: Array) -> bool:
        return bool(full_check(self.verdict, states))

    def bumped(self, rng: np.random.Generator, line: bool, many: bool) -> Array | None:
        """Return a clear path from the straight line, or else from bumps; from more of them where ``many``."""
        start, goal, size = self.ready.start, self.ready.goals[0], float(rng.uniform(*BUMP_SIZE))
        counts = (4 * MANY,) if many else (FEW, MANY)
        for count in counts:
            starts = self.optimizer.starts(start, goal, count + 1, rng, size)
            found = self.optimizer.first_valid(self.kernel, starts[:count] if line else starts[1:], self.is_valid)
            if found is not None:
                return found
        return None

    def searched(self, seed: int) -> Array | None:
        """Return the fit to a path that rrtconnect found, and that OMPL simplified."""
        seed_ompl(seed)
        setup, si = self._setup, self._setup.getSpaceInformation()
        setup.clear()
        setup.setPlanner(og.RRTConnect(si))
        left = iter(range(MOST_ITERATIONS))
        status = setup.solve(ob.PlannerTerminationCondition(lambda: next(left, None) is None))
        if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
            return None
        path = path_to_array(setup.getSolutionPath(), self.ready.robot.dof)
        path = simplify(og.PathSimplifier(si), si, path)
        path = np.concatenate([self.ready.start[None], path[1:-1], self.ready.goals[:1]])
        return self.optimizer.spline.fit(path, self.limits.lower, self.limits.upper).control

    def shortened(self, control: Array) -> Array | None:
        return self.optimizer.shorten(self.kernel, control, self.is_valid)

    def proven(self, control: Array) -> Array | None:
        """Return control points as they will be stored, or None when they fail the full check."""
        inner = self.optimizer.spline.inner
        stored = np.clip(control, self.limits.lower, self.limits.upper)
        stored[inner] = rounded(stored[inner], self.limits.lower, self.limits.upper)
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
        fitted = spline.fit(states, self.limits.lower, self.limits.upper).control
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
                if all(self.verdict.first_collision(line, SEARCH_RESOLUTION) is None for line in lines):
                    found.append(number)
                    break
            else:
                found.append(max(found, default=-1) + 1)
        return found

    def point(self, q: Array) -> Array:
        """Return the obstacle point that is nearest to the robot, tables excluded, shape (3,) [m]; by GJK."""
        key = q.tobytes()
        if key not in self._points:
            nearest = self.verdict.distance(q)
            self._points[key] = nearest.points[1] if nearest.first else np.array(NO_POINT)
        return self._points[key]

    def clearance(self, states: Array) -> float:
        """Return the clearance of the sphere cover along a path, at every other state [m]."""
        return float(self.kernel.clearance(states[::2], 0.2).min())


def rounded(control: Array, lower: Array, upper: Array) -> Array:
    """Return control points as half-precision numbers inside the limits, shape (..., dof)."""
    half = control.astype(np.float16)
    half = np.where(half.astype(float) > upper, np.nextafter(half, np.float16(-np.inf)), half)
    half = np.where(half.astype(float) < lower, np.nextafter(half, np.float16(np.inf)), half)
    return half.astype(float)


def _apart(spline: Spline, a: Array, b: Array) -> float:
    """Return how far two paths are apart at the same parameter [rad, max-norm]."""
    return float(np.abs(spline.path(a) - spline.path(b)).max())


def _thing(thing: Obstacle) -> tuple[int, Sequence[float], Sequence[float], Sequence[float]]:
    """Return number of the shape, position, orientation and size of an obstacle."""
    if thing.box is not None:
        size: Sequence[float] = thing.box
        kind = "box"
    elif thing.sphere is not None:
        size, kind = (thing.sphere.radius, 0.0, 0.0), "sphere"
    elif thing.cylinder is not None:
        size, kind = (thing.cylinder.radius, thing.cylinder.length, 0.0), "cylinder"
    elif thing.capsule is not None:
        size, kind = (thing.capsule.radius, thing.capsule.length, 0.0), "capsule"
    else:
        raise UnknownNameError("shape of an obstacle in a data set", "mesh or half_space", SHAPES)
    return SHAPES.index(kind), thing.position, thing.orientation, size
