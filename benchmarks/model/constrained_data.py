"""A data set of paths under constraints, as benchmarks/model/constrained_model.py trains models on.

Problems are those of the train split of the levels with constraints; the grammars of ``unseen`` have none there. Each
is solved as the planner does without a network: by the straight line and by trees on the constraints, whose paths are
cut short, optimized under constraints and shortened. Paths that are proved free and on the constraints are kept in both
directions. Control points are stored in half precision, so that the stored curve is near the constraints, not on them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from apex_ompl import problems
from apex_ompl.constraints.constraint_set import ConstraintSet
from apex_ompl.constraints.links import Links
from apex_ompl.constraints.paths import ConstrainedPaths
from apex_ompl.kernel.constraints import AXIS, POSITION, ROTATION
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import path_length
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.catalogue import CONSTRAINED, SPLITS, VALIDATION, SuiteError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.robot import Robot
from apex_ompl.training.engine import Engine, EngineOptions, PathFinder
from apex_ompl.training.records import Paths, to_half
from apex_ompl.training.store import Store
from apex_ompl.training.units import MeshPathFinder, problem_record
from apex_ompl.types import Array

UNIT = 20  # problems in a file
SEARCHES = 2  # of trees for a problem
TREE_ITERATIONS = 4000  # of a search, at most
DRAWS = 40  # of shortcuts along a path of trees, as in the planner
LONGEST = 1.25  # times the length of the shortest path of a problem, beyond which a path is not kept
LEVELS = tuple(f"{s}/{v}" for s, levels in CONSTRAINED.items() if s not in VALIDATION for v in levels)
PATHS = "paths"  # folder of the data set
HANDS = 2
CHAIN_SIZE, UPRIGHT_SIZE = 10, 5
TOLD = CHAIN_SIZE + HANDS * UPRIGHT_SIZE  # features of constraints
TOLERANCE_SCALE = 0.1  # of angles among them [rad]


def told(robot: Robot, constraints: ConstraintSet) -> Array:
    """Return what a model is told of constraints, shape (TOLD,).

    The first features are of a closed chain of both hands: 1, the position of the right palm in the left palm's frame
    [m], and the first two columns of the orientation of the right palm's joint in the frame of the left one's. Then
    follow, for each hand, those of an axis that is kept upright: 1, the axis in the frame of the palm's joint, and the
    tolerance in units of ``TOLERANCE_SCALE``. Zeros stand for what does not apply.

    Args:
        robot: A robot with two hands.
        constraints: Closed chains of its hands, and axes of what they hold that are upright.
    """
    palms = [hand.palm for hand in robot.hands.values()]
    joints = [Links.of(robot).point(palm, np.zeros(3)).joint for palm in palms]
    found = np.zeros(TOLD)
    for group in () if constraints.rows is None else constraints.rows.groups:
        first, second = group.first, group.second
        if group.kind == AXIS and first.joint == 0:
            at = CHAIN_SIZE + UPRIGHT_SIZE * joints.index(second.joint)
            found[at : at + UPRIGHT_SIZE] = 1.0, *second.rotation[:, 2], group.tolerance / TOLERANCE_SCALE
        elif [first.joint, second.joint] == joints:
            found[0] = 1.0
            if group.kind == POSITION:
                found[1:4] = group.value
            elif group.kind == ROTATION:
                found[4:CHAIN_SIZE] = (first.rotation @ second.rotation.T)[:, :2].T.ravel()
    return found


@dataclass(frozen=True)
class Violations:
    """Largest norms of rows along each of B paths, by their kind, shape (B,); NaN where there is none of it.

    Attributes:
        distance: Of a closed chain [m].
        angle: Of a closed chain [rad].
        tilt: Of an axis that is kept upright [rad].
    """

    distance: Array
    angle: Array
    tilt: Array


def violations(constraints: ConstraintSet, paths: Array) -> Violations:
    """Return how far paths, shape (B, N, dof), are off constraints."""
    assert constraints.rows is not None
    norms = constraints.rows.norms(paths.reshape(-1, paths.shape[-1])).reshape(*paths.shape[:2], -1).max(axis=1)
    kinds = np.array([group.kind for group in constraints.rows.groups])
    none = np.full(len(paths), np.nan)
    by_kind = (norms[:, kinds == kind] for kind in (POSITION, ROTATION, AXIS))
    return Violations(*(some.max(axis=1) if some.shape[1] else none for some in by_kind))


def paths_on(setup: PlanningSetup, spline: Spline) -> ConstrainedPaths:
    """Return what makes paths on the constraints of a problem; they are checked as in the planner."""
    checker = setup.checker
    assert setup.constraints is not None
    return ConstrainedPaths(
        checker.kernel, setup.constraints, Optimizer(spline), lambda states: bool(checker.prove(states, tolerance=0.0))
    )


class ConstrainedFinder(MeshPathFinder):
    """Finds paths on the constraints of a problem.

    Attributes:
        on_constraints: Makes them.
    """

    def __init__(self, setup: PlanningSetup, optimizer: Optimizer) -> None:
        """Find paths from the start to the first goal of ``setup``."""
        super().__init__(setup, optimizer)
        self.on_constraints = paths_on(setup, optimizer.spline)

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check, the proof of the constraints included."""
        return bool(full_check(self.setup.checker, states, constraints=self.setup.constraints))

    def quantize(self, control: Array) -> Array:
        """Return control points in the precision of the store, whose path is near the constraints."""
        inner = self.optimizer.spline.inner
        stored = np.clip(control, self.lower, self.upper)
        stored[inner] = to_half(stored[inner], self.lower, self.upper)
        return self.optimizer.spline.with_ends(stored, np.round(control[0], 6), np.round(control[-1], 6))

    def shortest(self, seed: int) -> list[tuple[str, Array]]:
        """Return source and control points of valid paths, not much longer than the shortest one."""
        paths, found = self.on_constraints, list[tuple[float, str, Array]]()
        for number in range(-1, SEARCHES):
            rng = np.random.default_rng([seed, number + 1])
            control = self.optimizer.spline.line(self.start, self.goal) if number < 0 else self._of_trees(rng)
            short = None if control is None else paths.shortened(control)
            if short is not None:
                found.append((path_length(short[1]), "line" if number < 0 else "rrtconnect", short[0]))
        least = min((length for length, *_ in found), default=0.0)
        return [(source, control) for length, source, control in found if length <= LONGEST * least]

    def _of_trees(self, rng: np.random.Generator) -> Array | None:
        paths = self.on_constraints
        trees = paths.trees(self.start[None], self.goal[None], rng)
        nodes = None if trees is None else trees.grow(TREE_ITERATIONS)
        return None if nodes is None else paths.fit(paths.shortcut(nodes, DRAWS, rng))


class ConstrainedEngine(Engine):
    """Solves problems with constraints."""

    def _search(self, finder: PathFinder, seed: int) -> Iterator[tuple[str, Array]]:
        assert isinstance(finder, ConstrainedFinder)
        yield from finder.shortest(seed)


def names(count: int) -> list[tuple[str, str, range]]:
    """Return suite, level and seeds of the units of about ``count`` problems, the levels in turn."""
    found = []
    for number in range(-(-count // UNIT)):
        turn, k = divmod(number, len(LEVELS))
        suite, level = LEVELS[k].split("/")
        found.append((suite, level, SPLITS["train"][turn * UNIT : (turn + 1) * UNIT]))
    return found


def make(folder: Path, count: int, model: TrajectoryModel) -> Iterator[str]:
    """Make the data set of about ``count`` problems, and yield the name of each unit; complete units are kept.

    Args:
        folder: Where the folder ``paths`` is made.
        count: Number of problems.
        model: Whose spline and latent space are used.
    """
    about = {"unit": UNIT, "searches": SEARCHES, "iterations": TREE_ITERATIONS}
    store = Store.create(folder / PATHS, about, tuple(about))
    with store.locked(), quiet_ompl():
        for number, (suite, level, seeds) in enumerate(names(count)):
            name = f"{number:04d}"
            if name not in store.units():
                store.write(name, unit(suite, level, seeds, model))
            yield name


def unit(suite: str, level: str, seeds: range, model: TrajectoryModel) -> Paths:
    """Return the paths of some problems; ``counts`` has what their constraints tell, by held objects."""
    engine = ConstrainedEngine(f"{suite}-{level}", (suite, level), "broad", EngineOptions(parts=0), model.spline)
    features: dict[str, list[float]] = {}
    sets: list[ConstraintSet] = []
    for seed in seeds:
        with suppress(SuiteError):  # no draw has a start and a goal
            problem = problems.load(f"{suite}/{level}/{seed}")
            setup = assemble(problem, robot())
            assert setup.constraints is not None
            entry = problem_record(problem, seed)
            before = engine.counts["solved"]
            engine.solve(ConstrainedFinder(setup, engine.optimizer), entry)
            if engine.counts["solved"] > before:
                features[entry.held] = told(robot(), setup.constraints).tolist()
                sets.append(setup.constraints)
    paths = engine.paths(robot().name, robot().joint_names)
    counts = {"told": features, **_statistics(paths, sets, model)} if len(paths) else {"told": features}
    return replace(paths, counts={**paths.counts, **counts})


def _statistics(paths: Paths, sets: list[ConstraintSet], model: TrajectoryModel) -> Mapping[str, list[list[float]]]:
    """Return how far stored paths, and their images in the latent space, are off the constraints, by path."""
    control, spline = paths.control(), paths.spline
    decoded = model.control(model.encode(control), (paths.start, paths.goal))
    found: dict[str, list[list[float]]] = {"stored": [], "latent": []}
    for k, owner in enumerate(paths.arrays["problem"]):
        for name, points in (("stored", control[k]), ("latent", decoded[k])):
            off = violations(sets[owner], spline.path(points)[None])
            found[name].append([float(values[0]) for values in (off.distance, off.angle, off.tilt)])
    return found


class DataStatistics(NamedTuple):
    """Statistics of a data set.

    Attributes:
        drawn: Number of problems that were drawn.
        solved: Number of those that were solved.
        paths: Number of paths, both directions counted.
        detour: Length over that of the straight line, of each path.
        stored: Largest distance and angle of a closed chain, and tilt, along each stored path, shape (N, 3) [m, rad].
        latent: The same of its image in the latent space.
    """

    drawn: int
    solved: int
    paths: int
    detour: Array
    stored: Array
    latent: Array


def statistics(folder: Path) -> DataStatistics:
    """Return the statistics of the data set that :func:`make` made in a folder."""
    units = [paths for paths in Store(folder / PATHS) if len(paths)]
    drawn, solved = (
        sum(int(paths.counts.get(name, 0)) for paths in Store(folder / PATHS)) for name in ("drawn", "solved")
    )
    detour = [paths.arrays["length"] / np.linalg.norm(paths.goal - paths.start, axis=1) for paths in units]
    off = (np.concatenate([np.array(paths.counts[name]) for paths in units]) for name in ("stored", "latent"))
    return DataStatistics(drawn, solved, sum(map(len, units)), np.concatenate(detour), *off)


def told_of(folder: Path) -> dict[str, Array]:
    """Return what constraints tell, shape (TOLD,) each, by the held objects, of the data set in a folder."""
    return {held: np.array(values) for paths in Store(folder / PATHS) for held, values in paths.counts["told"].items()}
