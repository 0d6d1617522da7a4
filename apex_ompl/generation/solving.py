"""Units of work drawn and solved by the data engine, with OMPL, meshes and models."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl import problems
from apex_ompl.datasets.engine import Engine, EngineOptions
from apex_ompl.datasets.path_finder import PathFinder
from apex_ompl.datasets.records import Paths
from apex_ompl.errors import ParameterError
from apex_ompl.generation.records import problem_record
from apex_ompl.generation.units import Unit
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.simplify import simplify
from apex_ompl.ompl_adapter.space import path_to_array
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.planners.tuned import TUNED
from apex_ompl.problems.generator import SuiteError
from apex_ompl.problems.suite_robot import robot
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.trajopt.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.resolution import SEARCH_RESOLUTION

if TYPE_CHECKING:
    from apex_ompl.diffusion.proposals import TrajectoryModel

MAX_ITERATIONS = 30_000  # of rrtconnect
BROAD_ITERATIONS = 8_000  # among broad scenes, where a problem need not have a solution


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
                    finder = OmplPathFinder(assemble(problem, robot()), engine.optimizer)
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
    from apex_ompl.diffusion.checkpoint import load_model

    model = load_model(name, robot=robot().name)
    if model.spline != spline:
        raise ParameterError("model", name, f"one of paths by {spline}")
    return model


def _proposer(model: TrajectoryModel, finder: OmplPathFinder) -> Callable[[int, int], Array]:
    """Return a function from a count and a seed to a model's proposals for a problem."""
    from apex_ompl.apex.query import make_query

    def propose(count: int, seed: int) -> Array:
        query = make_query(finder.setup.checker, finder.start, finder.goal, point=model.sees_point)
        with model.one_thread():
            return model.propose(query, finder.kernel, count, generator=np.random.default_rng(seed)).control

    return propose


class OmplPathFinder(PathFinder):
    """Finds paths with OMPL's RRTConnect too; checks them with meshes, and finds obstacle points by GJK.

    Attributes:
        setup: The problem, ready for OMPL.
        iterations: Of rrtconnect, at most.
    """

    def __init__(self, setup: PlanningSetup, optimizer: Optimizer) -> None:
        """Find paths from the start to the first goal of ``setup``."""
        super().__init__(setup.checker.kernel, setup.start, setup.goals[0], optimizer)
        self.setup = setup
        self.iterations = MAX_ITERATIONS

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check."""
        return bool(full_check(self.setup.checker, states))

    def is_free(self, line: Array) -> bool:
        """Whether a straight motion, shape (2, dof), is free at the resolution that planners search with."""
        return self.setup.checker.first_collision(line, SEARCH_RESOLUTION) is None

    def search(self, seed: int) -> Array | None:
        """Return the control points of a spline fitted to a simplified path of rrtconnect, or None."""
        seed_ompl(seed)
        simple_setup, si = self.setup.simple_setup, self.setup.simple_setup.getSpaceInformation()
        simple_setup.clear()
        planner = og.RRTConnect(si)
        planner.setRange(TUNED["rrtconnect"]["range"])
        simple_setup.setPlanner(planner)
        left = iter(range(self.iterations))
        status = simple_setup.solve(ob.PlannerTerminationCondition(lambda: next(left, None) is None))
        self._raise_faults()
        if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
            return None
        path = path_to_array(simple_setup.getSolutionPath(), self.setup.robot.dof)
        path = simplify(og.PathSimplifier(si), si, path)
        self._raise_faults()
        path = np.concatenate([self.start[None], path[1:-1], self.goal[None]])
        return self.optimizer.spline.fit(path, self.lower, self.upper).control

    def _raise_faults(self) -> None:
        """Raise the exception that OMPL's callbacks caught, Ctrl-C included."""
        fault = self.setup.validity_checker.fault or self.setup.motion_validator.fault
        if fault is not None:
            raise fault

    def obstacle_point(self, q: Array) -> Array:
        """Return the obstacle point nearest to the robot by GJK, fixtures such as tables excluded, shape (3,) [m]."""
        key = q.tobytes()
        if key not in self.points:
            self.points[key] = self.setup.checker.obstacle_point(q)
        return self.points[key]
