"""An imitation policy in the closed loop: its next chunks of states, followed unproved."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl.apex.models import make_query
from apex_ompl.baselines.control.short_horizon import along
from apex_ompl.collision import CollisionChecker
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import UNGUARDED, Answer, Request, register
from apex_ompl.moving.search import Search, fresh_checker, place
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.baselines.imitation.policy import ImitationPolicy

NAME = "policy"
STILL = 1e-6  # length of a way below which the policy does not move [rad]


@dataclass(eq=False)
class ImitationReplanner:
    """The policy of the planner ``il`` as a reflex (Kim, Ohmura and Kuniyoshi, IROS 2021), to the nearest goal.

    The inputs of the policy are the state that the robot will have, and the scene with obstacles where they are seen.
    Its share of time is the covered share of the initial distance to the goal. The next ``steps`` states of its clock
    are the control points of a motion that ends at rest, which the next replan replaces. A motion that ends within
    ``reach`` of the goal goes to the goal. Nothing is proved: only the policy avoids obstacles.

    Attributes:
        model: Name or folder of the policy.
        steps: Number of states of its clock that a motion follows.
        reach: Distance from the goal, of the farthest joint, below which the motion ends there [rad].
    """

    model: str = "il"
    steps: int = 64
    reach: float = 0.05
    _policy: ImitationPolicy | None = field(default=None, repr=False)
    _checker: CollisionChecker | None = field(default=None, repr=False)
    _whole: float = 0.0

    def prepare(self, context: RunContext) -> None:
        """Load the policy.

        Raises:
            ApexError: It is missing, damaged, or of another robot.
        """
        from apex_ompl.baselines.imitation.policy import shared_policy

        self._policy = shared_policy(self.model, robot=context.setup.robot.name)
        self._checker, self._whole = fresh_checker(context), 0.0
        self.states(context.setup.start, context.setup.start)

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return the unproved motion along the next states of the policy, or none."""
        search = Search(context, request, budget)
        if not len(search.goals):
            return Answer(None, NAME, budget)
        assert self._checker is not None and self._policy is not None
        for obstacle in request.obstacles:
            place(self._checker, obstacle, obstacle.position)
        goal = search.goals[0]
        states = self.states(search.start.position, goal)
        budget.spend("chunk of a policy", -(-(len(states) - 1) // self._policy.executed))
        if np.abs(states[-1] - goal).max() <= self.reach:
            states = np.concatenate([states, goal[None]])
        if np.abs(states - search.start.position).max() <= STILL:
            return Answer(None, NAME, budget)
        motion = along(search, states, states[-1])
        return Answer(None if motion is None else search.following(motion), NAME, budget)

    def states(self, start: Array, goal: Array) -> Array:
        """Return the next states of the policy among the obstacles that were placed last, shape (N, dof)."""
        assert self._policy is not None and self._checker is not None
        policy, distance = self._policy, float(np.linalg.norm(goal - start))
        self._whole = max(self._whole, distance)
        share = 1.0 - distance / self._whole if self._whole > 0.0 else 0.0
        first_step = min(round(share * (policy.clock - 1)), policy.clock - 2)
        query = make_query(self._checker, start, goal, point=policy.sees_point)
        found = policy.roll_out([query], self._checker.kernel, first_step=first_step, steps=self.steps)
        assert found is not None  # nothing stops it
        return np.asarray(found[0])


UNPROVED = {**UNGUARDED, "verified": False}
register("il", ImitationReplanner, "an imitation policy as a reflex, followed unproved", UNPROVED)
register("il-paper", partial(ImitationReplanner, "il-paper"), "the same, which sees one obstacle point", UNPROVED)
