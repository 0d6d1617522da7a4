"""Imitation learning: paths that a transformer policy rolls out, judged as they are (baseline of the paper)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from ompl import base as ob

from apex_ompl.apex.query import make_query
from apex_ompl.apex.start_goal import nearest_pairs, read_goals, read_starts
from apex_ompl.collision import CollisionChecker
from apex_ompl.errors import ParameterError
from apex_ompl.ompl_adapter.report import SolveReport
from apex_ompl.ompl_adapter.space import array_to_path, bounds_of, forget_states, to_state
from apex_ompl.ompl_adapter.validity import StateValidityChecker, full_check
from apex_ompl.planners.registry import Parameters, bounded, register
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.trajopt.path import Path
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.imitation.policy import ImitationPolicy

NAME, PAPER = "il", "il-paper"
LOG = logging.getLogger("apex_ompl")
Status = ob.PlannerStatus


class ImitationPlanner(ob.Planner):
    """OMPL planner: a policy rolled out once for each pair of start and goal, the nearest first.

    Nothing is searched for, and without ``repair`` nothing is corrected: a path counts if it is proved free as it is
    and ends at the goal. The policy is deterministic, so that there is no second try.

    Attributes:
        parameters: Its parameters.
        policy: The policy.
        report: What the last call of ``solve`` did; where it failed, ``reason`` says why for each pair.
    """

    def __init__(
        self, si: ob.SpaceInformation, checker: CollisionChecker, policy: ImitationPolicy, parameters: Imitation,
        name: str = NAME,
    ) -> None:  # fmt: skip
        """Roll out ``policy`` among the obstacles of ``checker``."""
        super().__init__(si, name)
        self.parameters, self.policy, self._checker, self._name = parameters, policy, checker, name
        self._optimizer = Optimizer()
        self.report = SolveReport()

    def setup(self) -> None:
        """Make all ready that the first call of ``solve`` would have to: kernel, network, optimiser."""
        super().setup()
        home = self._checker.robot.home
        query = make_query(self._checker, home, home, point=self.policy.sees_point)
        self.policy.roll_out([query], self._checker.kernel, steps=1)
        if self.parameters.repair:
            self._optimizer.prepare(self._checker.kernel)

    def clear(self) -> None:
        """Forget what was found."""
        super().clear()
        self.report = SolveReport()

    def solve(self, ptc: ob.PlannerTerminationCondition) -> ob.PlannerStatus:
        """Solve the problem; no exception leaves it, since one would end the process inside OMPL."""
        self.report = SolveReport()
        try:
            return self._solve(ptc)
        except Exception as error:
            LOG.exception("%s failed", self._name)
            forget_states(error)
            self.report.reason = f"{self._name} failed, {error!r}"
            return Status(Status.CRASH)

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> ob.PlannerStatus:
        report, begin, dof = self.report, time.perf_counter(), self._checker.robot.dof
        inputs = self.getPlannerInputStates()
        starts = read_starts(inputs, dof)
        if not starts:
            report.reason = "there is no valid start"
            return Status(Status.INVALID_START)
        goals = read_goals(inputs, dof, ptc, self.getProblemDefinition().getGoal())
        if not goals:
            report.reason = "there is no valid goal"
            return Status(Status.INVALID_GOAL)
        reasons: list[str] = []
        for start, goal in nearest_pairs(starts, goals):
            if ptc():
                break
            report.candidates += 1
            found = self._path(start, goal, lambda: bool(ptc()), reasons)
            if found is None:
                continue
            path, report.solved_by = found
            report.first = time.perf_counter() - begin
            report.first_verified, report.first_path, report.best_path = True, path, path
            report.lengths.append((report.first, path.length))
            solution = array_to_path(self.getSpaceInformation(), path.states)
            self.getProblemDefinition().addSolutionPath(solution, False, 0.0, self._name)
            return Status(Status.EXACT_SOLUTION)
        report.reason = "; ".join(dict.fromkeys(reasons))
        if not ptc():
            return Status(Status.ABORT)
        report.reason = report.reason or "time was up before a path was rolled out"
        return Status(Status.TIMEOUT)

    def _path(self, start: Array, goal: Array, stop: Callable[[], bool], reasons: list[str]) -> tuple[Path, str] | None:
        """Return a valid path from a start to a goal and how it was found, or None; why is added to ``reasons``."""
        report = self.report
        with report.timed("policy"):
            states = self._rolled(start, goal, stop)
        if states is None:
            return None
        report.proposed += 1
        with report.timed("check"):
            states, short = self._to_goal(states, goal)
            collision = full_check(self._checker, states)
        if not short and collision:
            return Path(states), self._name
        reasons += [reason for reason in (short, collision.reason) if reason]
        if not self.parameters.repair or stop():
            return None
        with report.timed("repair"):
            repaired = self._repaired(states, goal, stop)
        return None if repaired is None else (repaired, f"{self._name}+repair")

    def _rolled(self, start: Array, goal: Array, stop: Callable[[], bool]) -> Array | None:
        """Return the path of the policy, shape (N, dof), or None where it was told to stop."""
        checker, parameters = self._checker, self.parameters
        query = make_query(checker, start, goal, point=self.policy.sees_point)
        kernel = checker.kernel.within(*bounds_of(self.getSpaceInformation(), checker.robot))
        found = self.policy.roll_out([query], kernel, executed=parameters.executed, blend=parameters.blend, stop=stop)
        return None if found is None else found[0]

    def _to_goal(self, states: Array, goal: Array) -> tuple[Array, str]:
        """Return a path with its end at the goal where it comes near enough, and else by how much it stops short."""
        last, pdef = states[-1], self.getProblemDefinition()
        if pdef.getGoal().isSatisfied(to_state(self.getSpaceInformation(), last)):
            return states, ""
        if self.parameters.pin:
            return np.concatenate([states[:-1], goal[None]]), ""
        short = float(np.abs(goal - last).max())
        if short <= self.parameters.reach:
            return np.concatenate([states, goal[None]]), ""
        return states, f"the path stops {short:.3g} rad short of the goal"

    def _repaired(self, states: Array, goal: Array, stop: Callable[[], bool]) -> Path | None:
        """Return a valid path near a given one that ends at the goal, or None."""
        checker, spline = self._checker, self._optimizer.spline
        lower, upper = bounds_of(self.getSpaceInformation(), checker.robot)
        ended = np.concatenate([states[:-1], goal[None]])
        control = spline.fit(ended, lower, upper).control
        self._optimizer.prepare(checker.kernel)
        kernel = checker.kernel.within(lower, upper)
        found = first_valid(
            self._optimizer, kernel, control[None], lambda path: bool(checker.prove(path, tolerance=0.0)), stop
        )
        return None if found is None else Path.on(spline, found)


@register(NAME)
@dataclass(frozen=True)
class Imitation(Parameters):
    """A transformer policy that imitates the stored paths and sees the obstacles, rolled out once for each goal.

    The policy is that of Kim, Ohmura and Kuniyoshi (IROS 2021) without gaze and images: tokens of both arms' states,
    of goals and of obstacles in a transformer encoder, behaviour cloning by the mean square error; with chunks of
    states (Zhao et al. 2023). What the paper leaves open is chosen here: size and tokens of the network, a chunk of 16
    states of 256 of which 8 are followed, noise on the states of the training, and the straight line to the goal as
    what the network's output is added to. A path that ends within ``reach`` of the goal gets the goal as its last
    state, and the straight motion to it is proved like the rest; a path that ends farther away has failed.

    Attributes:
        model: Name or folder of a policy; ``il`` and ``il-paper`` lie in a clone, not in the wheel.
        executed: States of a chunk that are followed before the policy is asked again.
        blend: Whether a new chunk is blended with the rest of the one before.
        reach: Distance from the goal of any joint within which a path counts as one that reaches it.
        pin: Whether the last state is replaced by the goal however far away it is, as a control.
        repair: Whether a path that fails is fitted by a spline to the goal and repaired by the optimizer, as a control.
    """

    smooth: ClassVar[bool] = True
    model: str = NAME
    executed: int = bounded(8, 1, 256)
    blend: bool = True
    reach: float = bounded(0.05, 0.0, 1.0, unit="rad")
    pin: bool = False
    repair: bool = False
    name: ClassVar[str] = NAME

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ApexError: The policy is missing, damaged or of another robot, or ``si`` has no validity checker of this
                project.
        """
        from apex_ompl.imitation.policy import shared_policy

        validity_checker = si.getStateValidityChecker()
        if not isinstance(validity_checker, StateValidityChecker):
            expected = "apex_ompl's StateValidityChecker, as apex_ompl.setup sets it"
            raise ParameterError(f"state validity checker for {self.name}", type(validity_checker).__name__, expected)
        checker = validity_checker.checker
        policy = shared_policy(self.model, robot=checker.robot.name)
        return ImitationPlanner(si, checker, policy, self, self.name)


@register(PAPER)
@dataclass(frozen=True)
class ImitationPaper(Imitation):
    """The same with the condition of the paper, 35 floats: start, goal, and the obstacle point nearest to the start.

    The paper does not say how its own baseline sees obstacles; this is what its diffusion model is shown.
    """

    model: str = PAPER
    name: ClassVar[str] = PAPER
