"""Units of work drawn and solved by the data engine, with meshes and models."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl import problems
from apex_ompl.errors import ParameterError
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.paths.spline import Spline
from apex_ompl.problems.generator import SuiteError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.engine import Engine, EngineOptions
from apex_ompl.training.path_finder import PathFinder
from apex_ompl.training.problem_records import problem_record
from apex_ompl.training.records import Paths
from apex_ompl.training.units import Unit
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.model.proposals import TrajectoryModel

BROAD_ITERATIONS = 8_000  # of trees among broad scenes, where a problem need not have a solution


def solve_unit(unit: Unit, options: EngineOptions, spline: Spline) -> tuple[Paths, dict[str, float]]:
    """Draw and solve the problems of a unit; the same arguments give the same paths.

    Returns:
        The paths, and the time by stage [s].
    """
    engine = Engine(unit.name, (unit.suite, unit.level), unit.strategy, options, spline)
    model = _model(options.model, spline) if options.model else None
    with quiet_ompl():
        for seed in unit.seeds:
            with engine.timed("draw"):
                try:
                    problem = problems.load(f"{unit.suite}/{unit.level}/{seed}")
                    finder = MeshPathFinder(assemble(problem, robot()), engine.optimizer)
                except SuiteError:
                    engine.counts["not drawn"] += 1
                    continue
            if unit.strategy == "broad":
                finder.iterations = BROAD_ITERATIONS
            if model is not None:
                finder.proposer = _proposer(model, finder)
            engine.solve(finder, problem_record(finder.setup.problem, seed))
    return engine.paths(robot().name, robot().joint_names), engine.times


@cache
def _model(name: str, spline: Spline) -> TrajectoryModel:
    """Return a model of paths by a spline.

    Raises:
        ApexError: There is no such model, or it is for another robot or spline.
    """
    from apex_ompl.model.checkpoint import load_model

    model = load_model(name, robot=robot().name)
    if model.spline != spline:
        raise ParameterError("model", name, f"one of paths by {spline}")
    return model


def _proposer(model: TrajectoryModel, finder: MeshPathFinder) -> Callable[[int, int], Array]:
    """Return a function from a count and a seed to a model's proposals for a problem."""
    from apex_ompl.apex.query import make_query

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
