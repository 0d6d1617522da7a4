"""The paper's own replanning: one path of its diffusion model from where the robot stopped, followed unproved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from apex_ompl.apex.query import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.loop.replan.resuming import timed
from apex_ompl.model.checkpoint import shared_model
from apex_ompl.model.guidance import EQUATION_7
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.moving.charges import Charges
from apex_ompl.moving.placing import fresh_checker, place
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Answer, Request
from apex_ompl.moving.search import Search
from apex_ompl.types import Array

NAME = "proposal"


@dataclass(eq=False)
class OneProposal:
    """One path of the diffusion model to the nearest goal, as it comes (Algorithm 1 of the paper, generate_traj).

    Obstacles stand where they are seen. All steps of denoising are made, however long that takes.

    Attributes:
        guided: Whether the path is drawn away from obstacles while it is denoised (equation 7).
        model: Name or folder of the checkpoint.
    """

    guided: bool
    model: str = "apex-paper"
    _loaded: TrajectoryModel | None = field(default=None, repr=False)
    _checker: CollisionChecker | None = field(default=None, repr=False)

    def prepare(self, ready: Ready) -> None:
        """Load the model.

        Raises:
            ApexError: The checkpoint cannot be loaded, or is of another robot.
        """
        self._loaded, self._checker = shared_model(self.model, robot=ready.setup.robot.name), fresh_checker(ready)

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Answer:
        """Return a motion from rest along one path, which nothing has proved, or none where the robot moves."""
        search = Search(ready, request, charges)
        assert self._checker is not None
        if not request.following.at_rest(request.join):
            return Answer(None, NAME, charges)
        for obstacle in request.obstacles:
            place(self._checker, obstacle, obstacle.position)
        states = self.propose(search.start.position, search.goals[0], search.rng)
        charges.charge("guided path of the paper" if self.guided else "path of the paper")
        motion = timed(search, states)
        if motion is not None:
            search.take(motion, NAME)
        return Answer(search.best, NAME, charges)

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
