"""RRTConnect whose path is shortened, put on a spline and optimized."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.ompl.own_planner import OwnPlanner, Status
from apex_ompl.ompl.parameters import Parameters, bounded, register
from apex_ompl.ompl.repair import exact_paths, simplify
from apex_ompl.ompl.space import await_goal, path_to_array
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.optimizer import Optimizer, OptimizerSettings
from apex_ompl.paths.path import Path
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.constraints.constraint_set import ConstraintSet

NAME = "rrtconnect+polish"
TRIES = 3  # of shortening, until another checker accepts the path


def polished(
    optimizer: Optimizer, validator: PathValidator, states: Array, stop: Callable[[], bool] = lambda: False
) -> Path | None:
    """Return a short valid path near a given one, shape (N, dof), or None.

    The given path is fitted by ``optimizer.spline``, whose control points are optimized inside of the space's bounds.
    """
    kernel = validator.kernel
    limits = kernel.robot.arrays
    control = optimizer.spline.fit(states, limits.lower, limits.upper).control
    best = optimizer.shorten(kernel, control, lambda path: validator.is_valid(path, stop), stop)
    return None if best is None else Path.on(optimizer.spline, best)


class PolishedRRTConnect(OwnPlanner):
    """OMPL planner: RRTConnect, OMPL's simplification by counts, and trajectory optimization, until ``ptc`` ends it.

    What RRTConnect found is a solution as soon as it is found; the simplified and the optimized path are added to it,
    and OMPL gives the shortest. Where optimization finds nothing valid, the simplified path stands.

    Attributes:
        validator: Decides what is valid.
        report: Report on the last call of ``solve``.
    """

    def __init__(
        self, si: ob.SpaceInformation, validator: PathValidator, optimizer: Optimizer, inner: og.RRTConnect
    ) -> None:
        """Optimize what ``inner`` finds."""
        super().__init__(si, NAME)
        inner.setup()
        self.validator = validator
        self._optimizer = optimizer
        self._inner = inner

    def clear(self) -> None:
        """Forget the last solution."""
        super().clear()
        self._inner.clear()

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        self.validator = self.validator.current()
        si, pdef = self.getSpaceInformation(), self.getProblemDefinition()
        self._inner.setProblemDefinition(pdef)
        started = time.perf_counter()
        await_goal(pdef.getGoal(), ptc)
        with self.report.timed("rrtconnect"):
            status = self._inner.solve(ptc)
        if status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION:
            self.report.solved_by, self.report.first = NAME, time.perf_counter() - started
        if status.getStatus() != ob.PlannerStatus.EXACT_SOLUTION or ptc():
            return status.getStatus()
        dof = self.validator.checker.robot.dof
        self.report.first_path = path = Path(path_to_array(pdef.getSolutionPath(), dof))
        if self.validator.constraints is not None:
            return self._on_constraints(self.validator.constraints, path.states, started, ptc)
        with self.report.timed("simplify"):
            for _ in range(TRIES):
                short = Path(simplify(si, path.states, lambda: bool(ptc())))
                # the other checker samples shortened motions at other states than before
                if self.validator.accepts(short.states, lambda: bool(ptc())):
                    path = short
                    break
        self.report.add_solution(self, path, time.perf_counter() - started)
        if not ptc():
            with self.report.timed("polish"):
                better = polished(self._optimizer, self.validator, path.states, lambda: bool(ptc()))
            if better is not None:
                self.report.add_solution(self, better, time.perf_counter() - started)
        return status.getStatus()

    def _on_constraints(
        self, constraints: ConstraintSet, nodes: Array, started: float, ptc: ob.PlannerTerminationCondition
    ) -> Any:
        """Add paths that keep the constraints in place of the nodes that RRTConnect found, and return the status."""
        from apex_ompl.constraints.paths import ConstrainedPaths

        validator, rng = self.validator, np.random.default_rng(0)

        def stop() -> bool:
            return bool(ptc())

        self.getProblemDefinition().clearSolutionPaths()
        with self.report.timed("simplify"):
            exact = exact_paths(validator.checker, constraints, nodes, rng=rng, stop=stop)
            valid = next((Path(states) for states in exact if validator.is_valid(states, stop)), None)
        if valid is None:
            self.report.reason = "the path found is not valid between its states"
            return Status.TIMEOUT
        self.report.add_solution(self, valid, time.perf_counter() - started)
        paths = ConstrainedPaths(
            validator.kernel, constraints, self._optimizer, lambda states: validator.is_valid(states, stop), stop
        )
        if not ptc():
            with self.report.timed("polish"):
                better = paths.shortened(paths.fit(valid.states))
            if better is not None:
                self.report.add_solution(self, Path(better[1]), time.perf_counter() - started)
        return Status.EXACT_SOLUTION

    def _inner_planners(self) -> list[ob.Planner]:
        return [self._inner]


@register(NAME)
@dataclass(frozen=True)
class RRTConnectPolish(Parameters):
    """RRTConnect, simplified, fitted by a B-spline and optimized on its control points.

    Under constraints along the path, it is simplified by shortcuts on the constraints.

    Attributes:
        range: Longest step of RRTConnect's trees, by default the tuned one; 0 lets OMPL choose.
        control_points: Number of control points of the spline.
        pinned: How many of them coincide with each end.
        scene_margin: Clearance to obstacles that the optimizer asks for.
        own_margin: Clearance between the robot's links that it asks for.
        stiffness: Weight of the path's speed squared at first; it grows as long as paths stay valid.
    """

    smooth: ClassVar[bool] = True
    constrained: ClassVar[bool] = True
    range: float = bounded(TUNED[NAME]["range"], 0.0, unit="rad")
    control_points: int = bounded(14, 6, 200)
    pinned: int = bounded(1, 1, 90)
    scene_margin: float = bounded(0.04, 1e-4, 1.0, unit="m")
    own_margin: float = bounded(0.02, 1e-4, 1.0, unit="m")
    stiffness: float = bounded(1e-3, 1e-9, 1e3, unit="1/rad^2")

    def __post_init__(self) -> None:
        """Check that control points are left free.

        Raises:
            ParameterError: One is of the wrong type or out of range, or all are pinned.
        """
        super().__post_init__()
        Spline(self.control_points, self.pinned)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ParameterError: ``si`` has neither a validity checker of this project nor is it of ``apex_ompl.setup``.
        """
        validator = PathValidator.of_setup(si, NAME, constrained=True)
        settings = OptimizerSettings(
            scene_margin=self.scene_margin, own_margin=self.own_margin, stiffness=self.stiffness
        )
        optimizer = Optimizer(Spline(self.control_points, self.pinned), settings)
        optimizer.prepare(validator.kernel)
        inner = og.RRTConnect(si)
        inner.setRange(self.range)
        return PolishedRRTConnect(si, validator, optimizer, inner)
