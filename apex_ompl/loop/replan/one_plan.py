"""Replanners with one kind of plan: stop and wait, RRTConnect from rest, and the paper's single proposal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from ompl import base as ob

from apex_ompl.apex.models import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ApexError
from apex_ompl.loop.replan.portfolio import Portfolio
from apex_ompl.model.checkpoint import shared_model
from apex_ompl.model.guidance import EQUATION_7
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import Answer, Request
from apex_ompl.moving.retime import retime
from apex_ompl.moving.search import Search, fresh_checker, place, rest_of_route
from apex_ompl.ompl.process import seed_ompl
from apex_ompl.ompl.repair import simplify
from apex_ompl.ompl.setup import PlanningSetup, assemble, set_goals
from apex_ompl.ompl.space import path_to_array, to_state
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.ompl.validity import MotionValidator
from apex_ompl.planners.registry import parameters
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

RRTCONNECT = "rrtconnect"
NAME = "proposal"


def timed(search: Search, states: Array) -> Trajectory | None:
    """Return a motion from rest to rest along states, shape (N, dof), or None where none is found."""
    search.budget.spend("straight motion" if len(states) == 2 else "path in time")
    try:
        context = search.context
        return time_path(states, context.limits, context.names, motion_limits=context.torques).trajectory
    except ApexError:
        return None


@dataclass(eq=False)
class StopAndWait:
    """Stop and wait: the rest of the first plan, from where the robot stopped, as soon as that is proved.

    Attributes:
        first: Makes the first plan.
        retimes: Whether it is retimed among dynamic obstacles (path-velocity decomposition, Kant and Zucker 1986),
            while the robot moves and from rest.
    """

    first: Portfolio
    retimes: bool = False

    def prepare(self, context: RunContext) -> None:
        """Prepare what makes the first plan."""
        self.first.prepare(context)

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return a motion along what is left of the first plan, or none."""
        if request.route is None:
            return self.first.replan(context, request, budget)
        search = Search(context, request, budget)
        if not request.following.at_rest(request.join):
            return Portfolio([], self.retimes, evades=False).replan(context, request, budget)
        rest = rest_of_route(search)
        if rest is None:
            return Answer(None, "resume", budget)
        states = np.concatenate([search.start.position[None], rest[1:-1], request.route.motion.positions[-1:]])
        motion = timed(search, states)
        if motion is not None and search.accepts(motion):
            search.take(motion, "resume")
        elif motion is not None and self.retimes:
            made = retime(
                context.kernel, request.predicted, motion, context.limits, clock=request.join,
                hold=context.settings.hold,
            )  # fmt: skip
            budget.spend("retiming")
            if made.trajectory is not None and search.accepts(made.trajectory):
                search.take(made.trajectory, "retime")
        return Answer(search.best, search.part, budget)


@contextmanager
def spending(validator: MotionValidator, context: RunContext, budget: ComputeBudget, proved: bool) -> Iterator[None]:
    """While the block runs, count every motion that is checked, and check it continuously where asked."""
    check = validator.check

    def counted(first: Array, second: Array) -> bool:
        budget.spend("motion of a tree")
        return check(first, second) and (not proved or context.line_is_clear(first, second, budget))

    validator.check = counted
    try:
        yield
    finally:
        validator.check = check


@dataclass(eq=False)
class RRTConnectFromRest:
    """OMPL's RRTConnect, with its range tuned on validation problems, among obstacles where they are seen now.

    Its motion is followed if it is proved among the predicted obstacles. A proof as if obstacles were at rest is no
    better: of 24 worlds ``moving`` of the validation split, at a quarter of the velocity limits, 12 are solved with the
    prediction and 11 without. Where a motion is not proved clear of static obstacles, a path of proved straight motions
    is sought.
    """

    _setup: PlanningSetup | None = field(default=None, repr=False)

    def prepare(self, context: RunContext) -> None:
        """Set OMPL up with a checker of its own, whose obstacles each replan places."""
        self._setup = assemble(context.setup.problem, context.setup.robot, checker=fresh_checker(context))

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return a motion from rest that is proved among the predicted obstacles, or none."""
        search = Search(context, request, budget)
        for proved in (False, True) if request.following.at_rest(request.join) else ():
            states = self.path(search, proved)
            motion = None if states is None else timed(search, states)
            if motion is not None and search.accepts(motion):
                search.take(motion, RRTCONNECT)
            if states is None or search.best is not None or (motion is not None and context.clear_of_static(motion)):
                break
        return Answer(search.best, search.part, budget)

    def path(self, search: Search, proved: bool) -> Array | None:
        """Return a path among obstacles where they are seen now, shape (N, dof), or None.

        Args:
            search: The replan.
            proved: Whether each straight motion is checked continuously; else it is checked in steps.
        """
        assert self._setup is not None
        setup = self._setup
        for obstacle in search.request.obstacles:
            place(setup.checker, obstacle, obstacle.position)
        goals = [goal for goal in search.goals if setup.checker.is_free(goal)]
        if not goals or not setup.checker.is_free(search.start.position):
            return None
        simple_setup = setup.simple_setup
        si = simple_setup.getSpaceInformation()

        simple_setup.clear()
        simple_setup.setStartState(to_state(si, search.start.position))
        set_goals(simple_setup, goals)
        simple_setup.setPlanner(parameters(RRTCONNECT, **TUNED[RRTCONNECT]).build(si))
        seed_ompl(int(search.rng.integers(1, 2**31)))
        path = None
        with spending(setup.motion_validator, search.context, search.budget, proved):
            status = simple_setup.solve(ob.PlannerTerminationCondition(search.budget.over))
            if status.getStatus() == ob.PlannerStatus.EXACT_SOLUTION:
                found = path_to_array(simple_setup.getSolutionPath(), setup.robot.dof)
                path = simplify(si, found, search.budget.over)
        setup.raise_faults()
        if path is None:
            return None
        goal = min(goals, key=lambda goal: float(np.linalg.norm(goal - path[-1])))
        return np.concatenate([search.start.position[None], path[1:-1], goal[None]])


@dataclass(eq=False)
class OneProposal:
    """One path of the diffusion model to the nearest goal, as it comes (Algorithm 1 of the paper, generate_traj).

    Obstacles stand where they are seen. All steps of denoising are made, however long that takes.

    Attributes:
        guided: Whether guidance moves the path away from obstacles while it is denoised (equation 7).
        model: Name or folder of the checkpoint.
    """

    guided: bool
    model: str = "apex-paper"
    _loaded: TrajectoryModel | None = field(default=None, repr=False)
    _checker: CollisionChecker | None = field(default=None, repr=False)

    def prepare(self, context: RunContext) -> None:
        """Load the model.

        Raises:
            ApexError: The checkpoint cannot be loaded, or is of another robot.
        """
        self._loaded, self._checker = shared_model(self.model, robot=context.setup.robot.name), fresh_checker(context)

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return an unproved motion from rest along one path, or none where the robot moves."""
        search = Search(context, request, budget)
        assert self._checker is not None
        if not request.following.at_rest(request.join):
            return Answer(None, NAME, budget)
        for obstacle in request.obstacles:
            place(self._checker, obstacle, obstacle.position)
        states = self.propose(search.start.position, search.goals[0], search.rng)
        budget.spend("guided path of the paper" if self.guided else "path of the paper")
        motion = timed(search, states)
        if motion is not None:
            search.take(motion, NAME)
        return Answer(search.best, NAME, budget)

    def propose(self, start: Array, goal: Array, rng: np.random.Generator) -> Array:
        """Return a path between two states, shape (N, dof), among the obstacles that were placed last."""
        assert self._loaded is not None and self._checker is not None
        model, kernel = self._loaded, self._checker.kernel
        query = make_query(self._checker, start, goal, point=model.sees_point)
        guidance = EQUATION_7 if self.guided else replace(EQUATION_7, gamma=0.0)
        sampling = replace(model.sampling, guidance=guidance)
        with model.one_thread():
            made = model.propose(query, kernel, 1, sampling=sampling, generator=rng)
        return model.spline.path(made.control[0])
