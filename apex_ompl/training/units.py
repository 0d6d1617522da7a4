"""Units of work of the data engine: problems of a level that are drawn, solved with meshes, and stored together."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl import problems
from apex_ompl.collision.shapes import held_extent
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.model.geometry import SHAPES, ObstacleRecord
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.paths.spline import Spline
from apex_ompl.problems import robot_problems, scenes
from apex_ompl.problems.broad import GRAMMARS, SUITE
from apex_ompl.problems.broad_representation import part_of, swollen
from apex_ompl.problems.catalogue import KNOWN, LEVELS, SPLITS, TRAINING, VALIDATION, SuiteError
from apex_ompl.problems.suite_robot import ROBOT
from apex_ompl.scene.bodies import AttachedObject, Obstacle
from apex_ompl.scene.problem import Problem
from apex_ompl.training.engine import Engine, EngineOptions, PathFinder, ProblemRecord
from apex_ompl.training.kernel_problems import KernelProblem
from apex_ompl.training.records import Paths
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.model.proposals import TrajectoryModel

UNIT_SIZE = 16  # problems in a unit of work
BROAD_ITERATIONS = 8_000  # of trees among broad scenes, where a problem need not have a solution


@dataclass(frozen=True)
class Unit:
    """Unit of work: problems that are solved together, and whose paths are stored as one file.

    Attributes:
        suite: A suite, ``broad`` and ``unseen`` included.
        level: One of its levels.
        number: Index of the unit among those of the level.
        size: Number of problems that are drawn.
        split: Split of the problems' seeds.
        robot: Robot of the problems: that of the suites, or the file of another one, for ``broad`` alone.
    """

    suite: str
    level: str
    number: int
    size: int = UNIT_SIZE
    split: str = "train"
    robot: str = ROBOT

    @property
    def name(self) -> str:
        """Name of the unit, for example ``shelf-hard-00012``."""
        return f"{self.suite}-{self.level}-{self.number:05d}"

    @property
    def strategy(self) -> str:
        """How its problems are solved, a key of ``apex_ompl.training.engine.STRATEGIES``."""
        if self.suite in scenes.SUITES:
            return self.level
        return "broad" if self.level in GRAMMARS.get(self.suite, ()) else "open"

    @property
    def seeds(self) -> range:
        """Seeds of its problems."""
        return SPLITS[self.split][self.number * self.size :][: self.size]


LEVEL_WEIGHTS = {
    "extreme": 0.1, "vertical": 1.2, "horizontal": 1.2, "easy": 1.0, "medium": 0.8, "hard": 0.4,
}  # fmt: skip
"""Relative number of problems drawn of a level, by level or by suite: fewer where one takes longer."""

BROAD_SHARE = 2.0 / 3.0
"""Share of the levels of ``broad``, all alike, in problems of all suites."""


def static_levels(split: str = "train") -> list[tuple[str, str]]:
    """Return suite and level of all static levels with problems of a split."""
    known = {**LEVELS, **TRAINING} if split == "train" else KNOWN
    return [(s, level) for s, levels in known.items() for level in levels if not level.startswith("moving-")]


def level_weight(suite: str, level: str, split: str = "train") -> float:
    """Return the relative number of problems drawn of a level."""
    if suite in LEVELS:
        return LEVEL_WEIGHTS[level if level in LEVEL_WEIGHTS else suite]
    others = sum(level_weight(s, v, split) for s, v in static_levels(split) if s in LEVELS)
    return others * BROAD_SHARE / (1.0 - BROAD_SHARE) / len(KNOWN[suite])


def plan_units(count: int, only: Sequence[str] = (), split: str = "train") -> list[Unit]:
    """Return units of about ``count`` problems over all static suites and levels, the levels in turn.

    Args:
        count: Number of problems to draw, about.
        only: Suites, or ``suite/level``; none means all.
        split: Split of the problems.

    Raises:
        UnknownNameError: There is no such suite or level.
        ParameterError: Training problems are asked for of a suite that is for validation only.
    """
    for name in only:
        if split == "train" and name.partition("/")[0] in VALIDATION:
            reason = f"a suite for training: {name.partition('/')[0]} is for validation only"
            raise ParameterError("SUITE[/LEVEL]", name, reason)
    known = static_levels(split)
    for name in only:
        if name not in {s for s, _ in known} | {f"{s}/{level}" for s, level in known}:
            raise UnknownNameError("static suite or level", name, [f"{s}/{level}" for s, level in known])
    chosen = [(s, v) for s, v in known if not only or s in only or f"{s}/{v}" in only]
    weights = [level_weight(s, v, split) for s, v in chosen]
    found = [
        (k / weight, index, Unit(s, v, k, split=split))
        for index, ((s, v), weight) in enumerate(zip(chosen, weights, strict=True))
        for k in range(max(1, round(count * weight / sum(weights) / UNIT_SIZE)))
        if (k + 1) * UNIT_SIZE <= len(SPLITS[split])
    ]
    return [unit for *_, unit in sorted(found, key=lambda row: row[:2])]


def kernel_problems(unit: Unit) -> list[KernelProblem]:
    """Return the problems of a unit as tables of the kernel, for machines without Pinocchio, Coal and OMPL.

    There obstacles are primitives, which contain the meshes and the points that a problem has.
    """
    found = []
    with quiet_ompl():
        for seed in unit.seeds:
            try:
                problem, scene = drawn_problem(unit, seed)
            except SuiteError:
                continue
            setup = assemble(problem.model_copy(update={"scene": tuple(scene)}), robot_problems.robot_of(unit.robot))
            kernel, start, goal = setup.checker.kernel, setup.start, setup.goals[0]
            points = np.stack([setup.checker.obstacle_point(start), setup.checker.obstacle_point(goal)])
            names, record = (unit.name, unit.suite, unit.level, unit.strategy), problem_record(problem, seed, scene)
            found.append(KernelProblem(*names, record, kernel.robot, kernel.scene, start, goal, points))
    return found


def plan_robot_units(file: str, size: int, split: str = "train") -> Iterator[Unit]:
    """Yield units of problems for the robot of a file: the levels of ``broad`` in turn, until no seeds are left."""
    for number in range(len(SPLITS[split]) // size):
        for level in robot_problems.LEVELS:
            yield Unit(SUITE, level, number, size, split, file)


def drawn_problem(unit: Unit, seed: int) -> tuple[Problem, Sequence[Obstacle]]:
    """Return a problem of a unit, and its obstacles as primitives, which contain meshes and the balls around points.

    Raises:
        SuiteError: It cannot be drawn.
    """
    if unit.robot == ROBOT:
        problem = problems.load(f"{unit.suite}/{unit.level}/{seed}")
        return problem, problems.primitives(problem, enclosing=True)
    drawn = robot_problems.drawn_for(robot_problems.robot_of(unit.robot), unit.level, seed)
    problem = robot_problems.problem_of(drawn, unit.robot, unit.level, seed)
    return problem, swollen(drawn.scene, drawn.groups)


def problem_record(problem: Problem, seed: int, scene: Sequence[Obstacle] | None = None) -> ProblemRecord:
    """Return the record of a problem in a data set, by its obstacles as primitives, by default those of its id.

    Held meshes are named by their files, without folders; each held object has its ``extent``, see
    :func:`apex_ompl.collision.shapes.held_extent`.
    """
    scene = problems.primitives(problem, enclosing=True) if scene is None else scene
    return ProblemRecord(seed, held_text(problem.attached), [_obstacle_record(obstacle) for obstacle in scene])


def held_text(attached: Sequence[AttachedObject]) -> str:
    """Return held objects as JSON, as data sets store them."""
    bodies = [h.model_dump(mode="json", exclude_defaults=True) for h in attached]
    for body, held in zip(bodies, attached, strict=True):
        if "mesh" in body:
            body["mesh"]["file"] = Path(body["mesh"]["file"]).name
        body["extent"] = np.round(held_extent(held), 4).tolist()
    return json.dumps(bodies)


def _obstacle_record(obstacle: Obstacle) -> ObstacleRecord:
    """Return shape index, position, orientation and size of an obstacle.

    Raises:
        UnknownNameError: The obstacle is a mesh or a half-space.
    """
    if obstacle.shape not in SHAPES:
        raise UnknownNameError("shape of an obstacle in a data set", obstacle.shape, SHAPES)
    part = part_of(obstacle)
    return part.kind, obstacle.position, obstacle.orientation, part.size


def solve_unit(unit: Unit, options: EngineOptions, spline: Spline) -> tuple[Paths, dict[str, float]]:
    """Draw and solve the problems of a unit; the same arguments give the same paths.

    Returns:
        The paths, and the time by stage [s].
    """
    engine = Engine(unit.name, (unit.suite, unit.level), unit.strategy, options, spline)
    robot = robot_problems.robot_of(unit.robot)
    model = _model(options.model, spline, robot.name) if options.model else None
    with quiet_ompl():
        for seed in unit.seeds:
            with engine.timed("draw"):
                try:
                    problem, scene = drawn_problem(unit, seed)
                    finder = MeshPathFinder(assemble(problem, robot), engine.optimizer)
                except SuiteError:
                    engine.counts["not drawn"] += 1
                    continue
            if unit.strategy == "broad":
                finder.iterations = BROAD_ITERATIONS
            if model is not None:
                finder.proposer = _proposer(model, finder)
            engine.solve(finder, problem_record(finder.setup.problem, seed, scene))
    return engine.paths(robot.name, robot.joint_names), engine.times


@cache
def _model(name: str, spline: Spline, robot: str) -> TrajectoryModel:
    """Return a model of paths of a robot by a spline.

    Raises:
        ApexError: There is no such model, or it is for another robot or spline.
    """
    from apex_ompl.model.checkpoint import load_model

    model = load_model(name, robot=robot)
    if model.spline != spline:
        raise ParameterError("model", name, f"one of paths by {spline}")
    return model


def _proposer(model: TrajectoryModel, finder: MeshPathFinder) -> Callable[[int, int], Array]:
    """Return a function from a count and a seed to a model's proposals for a problem."""
    from apex_ompl.apex.models import make_query

    def propose(count: int, seed: int) -> Array:
        query = make_query(finder.setup.checker, finder.start, finder.goal, point=model.sees_point)
        with model.one_thread():
            return model.propose(query, finder.kernel, count, generator=np.random.default_rng(seed)).control

    return propose


class MeshPathFinder(PathFinder):
    """Checks paths with meshes, and finds obstacle points by GJK.

    Attributes:
        setup: The problem, ready for OMPL.
    """

    def __init__(self, setup: PlanningSetup, optimizer: Optimizer) -> None:
        """Find paths from the start to the first goal of ``setup``."""
        super().__init__(setup.checker.kernel, setup.start, setup.goals[0], optimizer)
        self.setup = setup

    def proves(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), inside of the limits is proved free, by the meshes where it takes them."""
        return bool(self.setup.checker.prove(states))

    def is_free(self, line: Array) -> bool:
        """Whether a straight motion, shape (2, dof), is free at the resolution that planners search with."""
        return self.setup.checker.first_collision(line, SEARCH_RESOLUTION) is None

    def obstacle_point(self, q: Array) -> Array:
        """Return the obstacle point nearest to the robot by GJK, fixtures such as tables excluded, shape (3,) [m]."""
        key = q.tobytes()
        if key not in self.points:
            self.points[key] = self.setup.checker.obstacle_point(q)
        return self.points[key]
