"""Problems of the training split drawn and solved by the data engine, with OMPL and the meshes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl import problems
from apex_ompl.datasets.cases import WrittenCase
from apex_ompl.datasets.engine import Case, Engine, Options, Row
from apex_ompl.datasets.records import SHAPES, Paths
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.simplify import simplify
from apex_ompl.ompl_adapter.space import path_to_array
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems import scenes
from apex_ompl.problems.catalogue import KNOWN, SPLITS
from apex_ompl.problems.generator import SuiteError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.trajopt.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.resolution import SEARCH_RESOLUTION

if TYPE_CHECKING:
    from apex_ompl.diffusion.proposals import TrajectoryModel


UNIT = 16  # problems in a unit of work
MOST_ITERATIONS = 30_000  # of rrtconnect


@dataclass(frozen=True)
class Unit:
    """Problems that are solved together, and whose paths are written together.

    Attributes:
        suite: A suite, or ``broad``.
        level: One of its levels.
        number: Counts the units of a level from 0.
        size: Number of problems that are drawn.
        split: The split that their seeds are of.
    """

    suite: str
    level: str
    number: int
    size: int = UNIT
    split: str = "train"

    @property
    def name(self) -> str:
        """Name of the unit, for example ``shelf-hard-00012``."""
        return f"{self.suite}-{self.level}-{self.number:05d}"

    @property
    def recipe(self) -> str:
        """How its problems are solved, see ``apex_ompl.datasets.engine.RECIPES``."""
        return self.level if self.suite in scenes.SUITES else "open"

    @property
    def seeds(self) -> range:
        """Seeds of its problems."""
        return SPLITS[self.split][self.number * self.size :][: self.size]


SHARES = {"broad": 6.0, "vertical": 1.2, "horizontal": 1.2, "easy": 1.0, "medium": 0.8, "hard": 0.4}
"""How many problems are drawn of a level of a suite, or of that level of the hard suites, in proportion: fewer where
one takes longer."""


def static_levels() -> list[tuple[str, str]]:
    """Return all suites and levels without moving obstacles, and the broad generator's."""
    return [(s, level) for s, levels in KNOWN.items() for level in levels if not level.startswith("moving-")]


def plan_units(count: int, only: Sequence[str] = (), split: str = "train") -> list[Unit]:
    """Return units of about ``count`` problems over all static suites and levels, the levels in turn.

    Args:
        count: How many problems to draw.
        only: Suites, or ``suite/level``; none means all.
        split: The split that they are of.

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
        (k / weight, place, Unit(s, v, k, split=split))
        for place, ((s, v), weight) in enumerate(zip(chosen, weights, strict=True))
        for k in range(max(1, round(count * weight / sum(weights) / UNIT)))
        if (k + 1) * UNIT <= len(SPLITS[split])
    ]
    return [unit for *_, unit in sorted(found, key=lambda row: row[:2])]


def work(unit: Unit, options: Options, spline: Spline) -> tuple[Paths, dict[str, float]]:
    """Draw and solve the problems of a unit; the same arguments give the same paths.

    Returns:
        The paths, and where the time went [s].
    """
    engine = Engine(unit.name, (unit.suite, unit.level), unit.recipe, options, spline)
    model = _model(options.model, spline) if options.model else None
    with quiet_ompl():
        for seed in unit.seeds:
            with engine.timed("draw"):
                try:
                    task = Task(assemble(problems.load(f"{unit.suite}/{unit.level}/{seed}"), robot()), engine.optimizer)
                except SuiteError:
                    engine.counts["not drawn"] += 1
                    continue
            if model is not None:
                task.proposer = _proposer(model, task)
            engine.solve(task, row_of(task.ready.problem, seed))
    return engine.paths(robot().name, robot().joint_names), engine.times


@cache
def _model(name: str, spline: Spline) -> TrajectoryModel:
    """Return a model whose paths fit.

    Raises:
        ApexError: There is none, or it is for another robot or spline.
    """
    from apex_ompl.diffusion.checkpoint import load_model  # torch, which data without a model need not

    model = load_model(name, robot=robot().name)
    if model.spline != spline:
        raise ParameterError("model", name, f"one of paths by {spline}")
    return model


def _proposer(model: TrajectoryModel, task: Task) -> Callable[[int, int], Array]:
    """Return what proposes paths for a problem, by a seed."""
    import torch

    from apex_ompl.apex.query import make_query
    from apex_ompl.util.threads import one_torch_thread

    def propose(count: int, seed: int) -> Array:
        query = make_query(task.ready.checker, task.start, task.goal, point=model.sees_point)
        with one_torch_thread():
            return model.propose(query, task.kernel, count, generator=torch.Generator().manual_seed(seed)).control

    return propose


class Task(Case):
    """A problem made ready: OMPL searches, the meshes have the last word, and GJK says which point is nearest."""

    def __init__(self, ready: PlanningSetup, optimizer: Optimizer) -> None:
        """Solve what ``ready`` is."""
        super().__init__(ready.checker.kernel, ready.start, ready.goals[0], optimizer)
        self.ready = ready

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check."""
        return bool(full_check(self.ready.checker, states))

    def is_free(self, line: Array) -> bool:
        """Whether a straight motion, shape (2, dof), is free at the resolution that planners search with."""
        return self.ready.checker.first_collision(line, SEARCH_RESOLUTION) is None

    def searched(self, seed: int) -> Array | None:
        """Return the fit to a path that rrtconnect found, and that OMPL simplified."""
        seed_ompl(seed)
        setup, si = self.ready.simple_setup, self.ready.simple_setup.getSpaceInformation()
        setup.clear()
        setup.setPlanner(og.RRTConnect(si))
        left = iter(range(MOST_ITERATIONS))
        status = setup.solve(ob.PlannerTerminationCondition(lambda: next(left, None) is None))
        self._raise_faults()
        if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
            return None
        path = path_to_array(setup.getSolutionPath(), self.ready.robot.dof)
        path = simplify(og.PathSimplifier(si), si, path)
        self._raise_faults()
        path = np.concatenate([self.start[None], path[1:-1], self.goal[None]])
        return self.optimizer.spline.fit(path, self.lower, self.upper).control

    def _raise_faults(self) -> None:
        """Raise what OMPL's callbacks kept, Ctrl-C among it."""
        fault = self.ready.validity_checker.fault or self.ready.motion_validator.fault
        if fault is not None:
            raise fault

    def point(self, q: Array) -> Array:
        """Return the obstacle point that is nearest to the robot, tables excluded, shape (3,) [m]; by GJK."""
        key = q.tobytes()
        if key not in self.points:
            self.points[key] = self.ready.checker.obstacle_point(q)
        return self.points[key]


def written(unit: Unit) -> list[WrittenCase]:
    """Return the problems of a unit for machines without Pinocchio."""
    found = []
    with quiet_ompl():
        for seed in unit.seeds:
            try:
                problem = problems.load(f"{unit.suite}/{unit.level}/{seed}")
            except SuiteError:
                continue
            task = Task(assemble(problem, robot()), Optimizer())
            points = np.stack([task.point(task.start), task.point(task.goal)])
            kernel, row = task.kernel, row_of(problem, seed)
            names = (unit.name, unit.suite, unit.level, unit.recipe)
            found.append(WrittenCase(*names, row, kernel.robot, kernel.scene, task.start, task.goal, points))
    return found


def row_of(problem: Problem, seed: int) -> Row:
    """Return what is written of a problem; meshes by the names of their files, without the folders."""
    bodies = [h.model_dump(mode="json", exclude_defaults=True) for h in problem.attached]
    for body in bodies:
        if "mesh" in body:
            body["mesh"]["file"] = Path(body["mesh"]["file"]).name
    held = json.dumps(bodies)
    return Row(seed, held, [_thing(thing) for thing in problem.scene])


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
