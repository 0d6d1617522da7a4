"""Fresh proposals of a trajectory model while the robot moves, with obstacles where they will be."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from apex_ompl.apex.models import Model, trajectory_model
from apex_ompl.apex.query import make_query
from apex_ompl.collision import CollisionChecker
from apex_ompl.model.query import Query
from apex_ompl.moving.placing import fresh_checker, place_nearest
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.search import Guess, Search, least_duration
from apex_ompl.moving.sources import rest_of_route
from apex_ompl.types import Array

TEMPERATURES = (1.0, 1.6)  # of the noise, in one replan after the other


@dataclass(eq=False)
class Proposals:
    """Paths of a latent diffusion model from the state that the robot will be in.

    The model was trained among obstacles that stand still. It is shown each obstacle that moves where it comes nearest
    to the straight line in time.

    Attributes:
        model: Name or folder of the checkpoint, see :func:`apex_ompl.apex.models.trajectory_model`.
        count: Number of proposals.
    """

    model: str = "auto"
    count: int = 4
    name: str = "proposals"
    _loaded: Model | None = field(default=None, repr=False)
    _checker: CollisionChecker | None = field(default=None, repr=False)

    def prepare(self, ready: Ready) -> None:
        """Load the model, and propose something.

        Raises:
            ApexError: The checkpoint cannot be loaded, or is of another robot.
        """
        setup = ready.setup
        self._loaded, self._checker = trajectory_model(self.model, setup.robot.name), fresh_checker(ready)
        query = make_query(self._checker, setup.start, setup.start, point=self._loaded.sees_point)
        with self._loaded.one_thread():
            self._loaded.propose(query, self._checker.kernel, self.count)

    @property
    def model_and_checker(self) -> tuple[Model, CollisionChecker]:
        """The model and the obstacles that it is shown, after :meth:`prepare`."""
        assert self._loaded is not None and self._checker is not None
        return self._loaded, self._checker

    def guesses(self, search: Search) -> Iterator[Guess]:
        """Yield the proposals."""
        (model, checker), goals = self.model_and_checker, search.goals
        if not len(goals):
            return
        goal = goals[0]
        place_nearest(checker, search, goal)
        query = make_query(checker, search.start.position, goal, point=model.sees_point)
        with model.one_thread():
            controls = self._made(search, query)
        for control in controls:
            states = model.spline.path(control)
            yield Guess(states, goal, least_duration(states, search.ready.limits))

    def _made(self, search: Search, query: Query) -> Array:
        """Return control points of proposals, shape (B, points, dof)."""
        model, checker = self.model_and_checker
        temperature = TEMPERATURES[search.request.number % len(TEMPERATURES)]
        sampling = model.sampling
        made = model.propose(
            query, checker.kernel, self.count, generator=search.rng,
            sampling=type(sampling)(sampling.sampler, sampling.steps, temperature, sampling.guidance),
        )  # fmt: skip
        search.charges.charge("proposals")
        search.charges.charge("proposal", self.count)
        return made.control


@dataclass(eq=False)
class Renoised(Proposals):
    """What is left of the last motion to a goal, noised and denoised again: the paper's resampling, in flight.

    Attributes:
        noises: How far it is noised, as shares of the schedule, in one replan after the other.
    """

    name: str = "renoise"
    noises: tuple[float, ...] = (0.15, 0.4)

    def _made(self, search: Search, query: Query) -> Array:
        rest = rest_of_route(search)
        model, checker = self.model_and_checker
        if rest is None:
            return np.empty((0, 0, 0))
        rest = rest + (search.start.position - rest[0]) * np.linspace(1.0, 0.0, len(rest))[:, None]
        limits = search.ready.limits
        control = model.spline.fit(rest, limits.lower, limits.upper).control
        noise = self.noises[search.request.number % len(self.noises)]
        made = model.renoise(
            query, checker.kernel, np.repeat(control[None], self.count, axis=0),
            max(0, round(noise * model.schedule.steps) - 1), generator=search.rng,
        )  # fmt: skip
        search.charges.charge("proposals")
        search.charges.charge("proposal", self.count)
        return made.control
