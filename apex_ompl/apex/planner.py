"""APEX: paths proposed by latent diffusion, checked, repaired, resampled, and completed by RRTConnect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Unpack
from weakref import WeakSet

import numpy as np
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.models import Model, ProposalSampler, make_query, trajectory_model
from apex_ompl.apex.parameters import AUTO, NAME, ApexKeywords, ApexParameters
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.apex.stages import Anytime, ConstrainedShorten, Shorten, Solution, Stage, run_stage
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.search import TreePair, shortcut
from apex_ompl.ompl.own_planner import (
    LOG,
    OwnPlanner,
    SolveReport,
    Status,
    Tree,
    nearest_pairs,
    read_goals,
    read_starts,
)
from apex_ompl.ompl.space import array_to_path
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.types import Array

MAX_EXPERIENCE = 4  # earlier paths that are candidates for the next query

_warm_models: WeakSet[Model] = WeakSet()  # that have proposed something in this process


class APEX(OwnPlanner):
    """OMPL planner APEX: section III of the paper inside ``solve``, probabilistically complete by RRTConnect.

    It works with any validity checker, and takes the one that is set when ``solve`` starts. With this project's,
    proposals are repaired, and guided if asked, among the obstacles; with another one they are checked by it. The first
    valid path is shortened; with the parameter ``anytime`` it is improved until the termination condition holds.

    Attributes:
        parameters: Its parameters.
        stages: Run in turn until one finds a path.
        validator: Decides what is valid.
        model: Makes proposals.
        optimizer: Repairs and shortens.
        experience: Control points of earlier paths minus those of their straight lines, each of shape (points, dof).
    """

    def __init__(
        self, si: ob.SpaceInformation, parameters: ApexParameters | None = None, *,
        stages: Sequence[Stage] | None = None, **values: Unpack[ApexKeywords],
    ) -> None:  # fmt: skip
        """Plan in the space of ``si``.

        Args:
            si: OMPL's space information.
            parameters: Parameters of the planner.
            stages: Stages that are run in turn until one finds a path, own ones of :mod:`apex_ompl.apex.stages` or
                objects with the method ``run(context)``; by default ``parameters.stages()``.
            **values: Parameters by name, such as ``robot`` and ``seed``, in place of these.

        Raises:
            ApexError: The model or the robot cannot be loaded, or do not fit the space; there is no such parameter.
        """
        super().__init__(si, NAME)
        given = self.parameters = (parameters or ApexParameters()).changed(**values)
        self.stages = given.stages() if stages is None else list(stages)
        self._constrained_stages = given.constrained_stages() if stages is None else self.stages
        self.validator = PathValidator(si, "" if given.robot == AUTO else given.robot)
        robot = self.validator.checker.robot
        self.model = trajectory_model(self.parameters.model, robot, self.parameters.device)
        steps, most = self.parameters.denoising_steps, self.model.schedule.steps
        if steps > most:
            raise ParameterError("parameter 'denoising_steps'", steps, f"at most {most}, those of the checkpoint")
        self.optimizer = Optimizer(self.model.spline)
        self.experience: list[Array] = []
        self._solves = 0
        self._warm = False
        self._grown: list[TreePair | og.RRTConnect] = []  # by the last call of ``solve``

    def setup(self) -> None:
        """Prepare what the first call of ``solve`` needs: kernel, network, optimizer."""
        super().setup()
        self._prepare()

    def _prepare(self) -> None:
        before, self.validator = self.validator, self.validator.current()
        self._warm &= self.validator is before
        if self._warm:
            return
        checker = self.validator.checker
        self.optimizer.prepare(checker.kernel)
        home = checker.robot.home
        ends = home[None], home[None]
        rng = np.random.default_rng(0)
        TreePair(self.validator.kernel, *ends, 1.0, SEARCH_RESOLUTION, rng).grow(1)
        shortcut(self.validator.kernel, np.stack([home] * 3), 1, SEARCH_RESOLUTION, rng)
        if self.model not in _warm_models:
            query = make_query(checker, home, home, point=self.model.sees_point)
            sampling = self.parameters.sampling(self.model.sampling)
            quick = replace(sampling, sampler="ddim", steps=min(2, sampling.steps))
            with self.model.one_thread():
                self.model.propose(query, self.validator.kernel, 1, sampling=quick)
            _warm_models.add(self.model)
        if self.parameters.lambda_obs > 0.0:
            self.validator.obstacle_distance(np.stack([home, home]))
        self._warm = True

    def clear(self) -> None:
        """Forget everything found so far."""
        super().clear()
        self.clearQuery()
        self.experience = []

    def clearQuery(self) -> None:  # noqa: N802 - OMPL's name
        """Forget the query; earlier paths stay candidates for the next one."""
        self._solves, self.report, self.rejected_lines, self._grown = 0, SolveReport(), [], []

    def next_seed(self) -> int:
        """Return the seed of the next call of ``solve``: one that follows from the given one, or from OMPL's."""
        first = self.parameters.seed if self.parameters.seed >= 0 else int(ou.RNG().uniformInt(0, 2**31 - 2))
        self._solves += 1
        return first + self._solves - 1

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        """Read the query, run the stages in turn until one finds a path, shorten it and improve it."""
        self._prepare()
        with self.model.one_thread():
            context = self._context(ptc)
            status, reason = _read_query(context)
            if reason:
                return _unsolved(context, status, reason)
            for stage in self.stages if context.constrained is None else self._constrained_stages:
                found = run_stage(stage, context)
                if found is not None:
                    self._accept(context, found)
                    return Status.EXACT_SOLUTION
            count = context.report.candidates
            _unsolved(context, Status.TIMEOUT, f"no path among {count} candidates in the time given")
            if context.nearest is None:
                return Status.TIMEOUT
            path, distance = context.nearest
            solution = array_to_path(context.si, path.states)
            self.getProblemDefinition().addSolutionPath(solution, True, distance, NAME)
            return Status.APPROXIMATE_SOLUTION

    def _accept(self, context: SolveContext, found: Solution) -> None:
        """Accept what a stage found, shorten it and improve it."""
        parameters = self.parameters
        context.report.solved_by = found.stage
        context.accept(found.path)
        if context.constrained is not None:
            if parameters.polish or parameters.anytime:
                ConstrainedShorten(parameters.first, parameters.anytime).run(context)
            return
        if parameters.polish:
            Shorten(parameters.range if parameters.fallback else None).run(context)
        Anytime(parameters.anytime).run(context)
        _remember(context)

    def _context(self, ptc: ob.PlannerTerminationCondition) -> SolveContext:
        """Return what the stages of one call share."""
        parameters = self.parameters
        generator = np.random.default_rng(self.next_seed())
        sampler = ProposalSampler(
            self.model, self.validator.kernel, parameters.sampling(self.model.sampling),
            generator=generator, stop=lambda: bool(ptc()), report=self.report,
        )  # fmt: skip
        context = SolveContext(
            self, ptc, validator=self.validator, sampler=sampler,
            optimizer=self.optimizer, report=self.report, experience=self.experience,
            rejected_lines=self.rejected_lines, lambda_obs=parameters.lambda_obs, rng=generator.spawn(1)[0],
        )  # fmt: skip
        self._grown = context.grown
        return context

    def _trees(self) -> list[Tree]:
        pairs = [trees for trees in self._grown if isinstance(trees, TreePair)]
        return [Tree(*pair.nodes(number), bool(number)) for pair in pairs for number in range(2)]

    def _inner_planners(self) -> list[ob.Planner]:
        return [trees for trees in self._grown if isinstance(trees, ob.Planner)]


def _read_query(context: SolveContext) -> tuple[Any, str]:
    """Read starts and goals into the context; return a status and a reason where they are of no use."""
    inputs, dof = context.planner.getPlannerInputStates(), context.kernel.robot.dof
    with context.report.timed("query"):
        context.starts = read_starts(inputs, dof)
        goal = context.pdef.getGoal()
        if goal is not None and not goal.hasType(ob.GOAL_SAMPLEABLE_REGION):
            reason = "the goal cannot be sampled, expected a goal state, goal states or a sampleable region"
            return Status.UNRECOGNIZED_GOAL_TYPE, reason
        context.goals = [] if goal is None else read_goals(inputs, dof, context.ptc, goal)
        if not context.starts:
            return Status.INVALID_START, "no start state is valid"
        if not context.goals:
            return Status.TIMEOUT if context.stop() else Status.INVALID_GOAL, "no valid goal state was sampled"
        context.pairs = nearest_pairs(context.starts, context.goals)
    return None, ""


def _unsolved(context: SolveContext, status: Any, reason: str) -> Any:
    context.report.reason = reason
    LOG.info("apex: %s", reason)
    return status


def _remember(context: SolveContext) -> None:
    """Keep the difference between the best path and its straight line for later queries, if it is a spline."""
    best = context.best
    if best is not None and best.spline is not None and best.control is not None:
        difference: Array = best.control - best.spline.line(best.control[0], best.control[-1])
        context.experience.insert(0, difference)
        del context.experience[MAX_EXPERIENCE:]
