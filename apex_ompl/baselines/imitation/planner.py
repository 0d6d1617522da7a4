"""Imitation learning: paths that a transformer policy rolls out, judged as they are (baseline of the paper)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from ompl import base as ob

from apex_ompl.apex.models import make_query
from apex_ompl.apex.path_validator import NOT_ACCEPTED, PathValidator
from apex_ompl.ompl.own_planner import OwnPlanner, nearest_pairs
from apex_ompl.ompl.parameters import Parameters, bounded, register
from apex_ompl.ompl.space import bounds_of, to_state
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import Path
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.baselines.imitation.policy import ImitationPolicy

NAME, PAPER = "il", "il-paper"
Status = ob.PlannerStatus


class ImitationPlanner(OwnPlanner):
    """OMPL planner: a policy rolled out once for each pair of start and goal, the nearest first.

    Nothing is searched for, and without ``repair`` nothing is corrected: a path counts if it is proved free as it is
    and ends at the goal. The policy is deterministic, so that there is no second try.

    Attributes:
        parameters: Its parameters.
        policy: The policy.
        validator: Decides what is valid.
        report: What the last call of ``solve`` did; where it failed, ``reason`` says why for each pair.
    """

    def __init__(
        self, si: ob.SpaceInformation, validator: PathValidator, policy: ImitationPolicy, parameters: Imitation,
        name: str = NAME,
    ) -> None:  # fmt: skip
        """Roll out ``policy`` among the obstacles of the validator's checker."""
        super().__init__(si, name)
        self.parameters, self.policy, self.validator = parameters, policy, validator
        self._optimizer = Optimizer()

    def setup(self) -> None:
        """Make all ready that the first call of ``solve`` would have to: kernel, network, optimizer."""
        super().setup()
        checker = self.validator.checker
        home = checker.robot.home
        query = make_query(checker, home, home, point=self.policy.sees_point)
        self.policy.roll_out([query], checker.kernel, steps=1)
        if self.parameters.repair:
            self._optimizer.prepare(checker.kernel)

    def _solve(self, ptc: ob.PlannerTerminationCondition) -> Any:
        self.validator = self.validator.current()
        report, started = self.report, time.perf_counter()
        starts, goals, status = self._ends(ptc)
        if status is not None:
            return status
        reasons: list[str] = []
        for start, goal in nearest_pairs(starts, goals):
            if ptc():
                break
            report.candidates += 1
            found = self._path(start, goal, lambda: bool(ptc()), reasons)
            if found is None:
                continue
            path, report.solved_by = found
            report.first_verified = True
            report.add_solution(self, path, time.perf_counter() - started)
            return Status.EXACT_SOLUTION
        report.reason = "; ".join(dict.fromkeys(reasons))
        if not ptc():
            return Status.ABORT
        report.reason = report.reason or "time was up before a path was rolled out"
        return Status.TIMEOUT

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
            fault = self._fault(states, stop)
        if not short and not fault:
            return Path(states), self._name
        reasons += [reason for reason in (short, fault) if reason]
        if not self.parameters.repair or stop():
            return None
        with report.timed("repair"):
            repaired = self._repaired(states, goal, stop)
        return None if repaired is None else (repaired, f"{self._name}+repair")

    def _fault(self, states: Array, stop: Callable[[], bool]) -> str:
        """Return why a path, shape (N, dof), is not valid, or nothing."""
        found = full_check(self.validator.checker, states).reason if self.validator.knows_obstacles else ""
        return found or ("" if self.validator.accepts(states, stop) else NOT_ACCEPTED)

    def _rolled(self, start: Array, goal: Array, stop: Callable[[], bool]) -> Array | None:
        """Return the path of the policy, shape (N, dof), or None where it was stopped."""
        checker, parameters = self.validator.checker, self.parameters
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
        checker, spline = self.validator.checker, self._optimizer.spline
        lower, upper = bounds_of(self.getSpaceInformation(), checker.robot)
        ended = np.concatenate([states[:-1], goal[None]])
        control = spline.fit(ended, lower, upper).control
        self._optimizer.prepare(checker.kernel)
        kernel = checker.kernel.within(lower, upper)
        found = first_valid(
            self._optimizer, kernel, control[None], lambda path: self.validator.is_valid(path, stop), stop
        )
        return None if found is None else Path.on(spline, found)


@register(NAME)
@dataclass(frozen=True)
class Imitation(Parameters):
    """A transformer policy that imitates the stored paths and sees the obstacles, rolled out once for each goal.

    The policy is that of Kim, Ohmura and Kuniyoshi (IROS 2021) without gaze and images: tokens of both arms' states,
    of goals and of obstacles in a transformer encoder, behavior cloning by the mean square error; with chunks of
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
            ApexError: The policy is missing, damaged or of another robot, or ``si`` has neither a validity checker of
                this project nor is it of ``apex_ompl.setup``.
        """
        from apex_ompl.baselines.imitation.policy import shared_policy

        validator = PathValidator.of_setup(si, self.name)
        policy = shared_policy(self.model, robot=validator.checker.robot.name)
        return ImitationPlanner(si, validator, policy, self, self.name)


@register(PAPER)
@dataclass(frozen=True)
class ImitationPaper(Imitation):
    """The same with the condition of the paper, 35 floats: start, goal, and the obstacle point nearest to the start.

    The paper does not say how its own baseline sees obstacles; this is what its diffusion model is shown.
    """

    model: str = PAPER
    name: ClassVar[str] = PAPER
