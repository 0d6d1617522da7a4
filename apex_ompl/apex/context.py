"""Context of one call of ``solve``, shared by the stages of APEX."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from ompl import base as ob

from apex_ompl.apex.models import make_query, rough_kernel
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.ompl.own_planner import SolveReport
from apex_ompl.paths.candidates import Candidate, CandidatePool
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import Path
from apex_ompl.types import Array

if TYPE_CHECKING:
    from ompl import geometric as og

    from apex_ompl.apex.models import ProposalSampler
    from apex_ompl.apex.stages.trees import OmplTrees
    from apex_ompl.constraints.paths import ConstrainedPaths
    from apex_ompl.kernel.constraints import ConstrainedTreePair
    from apex_ompl.kernel.search import SearchCounts, TreePair
    from apex_ompl.model.query import Query

MIN_GAIN = 1e-3  # least decrease of length that counts as an improvement [rad]
CLEARANCE_SPACING = 0.1  # of a path's states whose distance from obstacles is compared [rad, max-norm]


class SolveContext:
    """Query, checker, candidates, best path and budget of one call of ``solve``.

    Attributes:
        planner: The planner, whose solutions are entered.
        si: OMPL's space information.
        pdef: OMPL's problem definition; solutions are added to it.
        ptc: OMPL's termination condition, the budget.
        validator: Decides what is valid.
        sampler: Makes proposals.
        optimizer: Repairs and shortens paths.
        report: Times and counts.
        starts: Start states, each of shape (dof,).
        goals: Goal states, each of shape (dof,).
        pairs: Pairs of start and goal that proposals are made for, the nearest first.
        experience: Control points of earlier paths minus those of their straight lines, each of shape (points, dof).
        rejected_lines: Straight lines that were found invalid before, each of shape (2, dof).
        lambda_obs: Wanted distance from obstacles [m].
        pool: Candidates of the round of proposals.
        unchecked: Known candidates that wait for the first round: origin and control points.
        set_aside: Valid candidates nearer to obstacles than ``lambda_obs``, each with its distance [m].
        best: Shortest valid path, or None.
        nearest: Path that ends near a goal and its distance from it [rad], or None.
        rng: Source of the generators of compiled trees.
        sprint_trees: Compiled trees of the sprints, or None.
        sprint_ompl_trees: OMPL's, where another checker decides, by their longest step [rad].
        all_trees: Compiled trees for all starts and goals, or None.
        all_ompl_trees: OMPL's for all starts and goals, or None.
        grown: Trees between starts and goals so far, for OMPL's planner data.
        constrained: Makes paths on the constraints along the path, or None where there are none.
        constrained_trees: Trees on the constraints that have not met, or None.
        tree_nodes: Nodes of the path that such trees found last, shape (N, dof), or None.
    """

    def __init__(
        self, planner: ob.Planner, ptc: ob.PlannerTerminationCondition, *, validator: PathValidator,
        sampler: ProposalSampler, optimizer: Optimizer, report: SolveReport, experience: list[Array],
        rejected_lines: list[Array], lambda_obs: float, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Share what is given; starts and goals are read before the stages run."""
        self.started = time.perf_counter()
        self.planner, self.ptc = planner, ptc
        self.si, self.pdef = planner.getSpaceInformation(), planner.getProblemDefinition()
        self.validator, self.sampler, self.optimizer, self.report = validator, sampler, optimizer, report
        self.experience, self.rejected_lines, self.lambda_obs = experience, rejected_lines, lambda_obs
        self.starts: list[Array] = []
        self.goals: list[Array] = []
        self.pairs: list[tuple[Array, Array]] = []
        self.kernel = validator.kernel
        self.pool = self.new_pool()
        self.unchecked: list[tuple[str, Array]] = []
        self.set_aside: list[tuple[float, Candidate]] = []
        self.best: Path | None = None
        self.nearest: tuple[Path, float] | None = None
        self.rng = rng
        self.sprint_trees: TreePair | None = None
        self.sprint_ompl_trees: dict[float, OmplTrees] = {}
        self.all_trees: TreePair | None = None
        self.all_ompl_trees: OmplTrees | None = None
        self.grown: list[TreePair | og.RRTConnect] = []
        self.constrained: ConstrainedPaths | None = None
        if validator.constraints is not None:
            from apex_ompl.constraints.paths import ConstrainedPaths

            self.constrained = ConstrainedPaths(
                self.kernel, validator.constraints, optimizer, lambda states: validator.is_valid(states, self.stop),
                self.stop,
            )  # fmt: skip
        self.constrained_trees: ConstrainedTreePair | None = None
        self.tree_nodes: Array | None = None
        self._queries: list[Query] = []

    @property
    def queries(self) -> list[Query]:
        """What the model is conditioned on, one query a pair of start and goal."""
        if not self._queries:
            point = self.sampler.model.sees_point
            with self.report.timed("query"):
                self._queries = [make_query(self.validator.checker, a, b, point=point) for a, b in self.pairs]
        return self._queries

    def note_search(self, looked: SearchCounts) -> None:
        """Add the checks of a search in compiled code to the checker's counts."""
        counts = self.validator.checker.check_counts
        counts.proved += looked.proved
        counts.blocked += looked.blocked
        counts.intervals += looked.intervals
        counts.proved_intervals += looked.proved_intervals

    def stop(self) -> bool:
        """Whether time is up."""
        return bool(self.ptc())

    def is_valid(self, states: Array) -> bool:
        """Whether a path, shape (N, dof), passes the full check."""
        constraints = self.validator.constraints
        if constraints is not None:
            from apex_ompl.constraints.proof import prove_path

            if not prove_path(constraints, states):
                return False
        return self.validator.is_valid(states, self.stop)

    def new_pool(self) -> CandidatePool:
        """Return an empty pool of candidates."""
        return CandidatePool(
            self.optimizer, self.kernel, self.is_valid, self.accepts_distance, collides=self.validator.collides,
            rough=lambda: rough_kernel(self.kernel),
        )  # fmt: skip

    def spline_path(self, control: Array) -> Path:
        """Return the path of control points, shape (points, dof)."""
        return self.weighed(Path.on(self.optimizer.spline, control))

    def weighed(self, path: Path) -> Path:
        """Return a path whose length weighs the joints as the robot does."""
        return replace(path, weights=self.kernel.robot.arrays.weight)

    def fit(self, states: Array) -> Array:
        """Return control points of the spline nearest to a polyline, shape (points, dof)."""
        limits = self.kernel.robot.arrays
        return self.optimizer.spline.fit(states, limits.lower, limits.upper).control

    def accepts_distance(self, candidate: Candidate, states: Array) -> bool:
        """Whether a valid path keeps ``lambda_obs`` from obstacles; one that does not is set aside."""
        if self.lambda_obs <= 0.0:
            return True
        with self.report.timed("distance"):
            distance = self.validator.obstacle_distance(states)
        if distance < self.lambda_obs:
            self.set_aside.append((distance, replace(candidate)))  # as it is now
        return distance >= self.lambda_obs

    def farthest(self) -> Candidate | None:
        """Return the candidate set aside that keeps the largest distance from obstacles, or None."""
        return max(self.set_aside, key=lambda pair: pair[0])[1] if self.set_aside else None

    def accept(self, path: Path) -> None:
        """Add a valid path to OMPL's solutions."""
        path = self.weighed(path)
        if self.best is None:
            self.report.first_verified = self.validator.knows_obstacles
        self.report.add_solution(self.planner, path, time.perf_counter() - self.started)
        self.best = path

    def accept_if_shorter(self, path: Path) -> bool:
        """Accept a valid path if it is shorter, and no nearer to obstacles than is wanted, or than the best path.

        Returns:
            Whether it was accepted.
        """
        path = self.weighed(path)
        if self.best is not None:
            if path.length > self.best.length - MIN_GAIN:
                return False
            if self.lambda_obs > 0.0:
                with self.report.timed("distance"):
                    distance = self.validator.obstacle_distance(path.states)
                    best = self.best.sample(CLEARANCE_SPACING)
                    if distance < self.lambda_obs and distance < self.validator.obstacle_distance(best):
                        return False
        self.accept(path)
        return True

    def counted(self, calls: int) -> ob.PlannerTerminationCondition:
        """Return OMPL's termination condition that holds when time is up, or after some calls."""
        left = iter(range(calls))
        return ob.PlannerTerminationCondition(lambda: self.stop() or next(left, None) is None)


def joins(control: Array, start: Array, goal: Array) -> bool:
    """Whether control points, shape (points, dof), start and end at a start and a goal, shape (dof,)."""
    return np.array_equal(control[0], start) and np.array_equal(control[-1], goal)
