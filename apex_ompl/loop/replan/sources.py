"""Sources of initial motions: the remaining motion, straight lines, proposals of a model, and a sprint of trees."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from apex_ompl.apex.models import Model, make_query, trajectory_model
from apex_ompl.collision import CollisionChecker
from apex_ompl.kernel.search import TreePair
from apex_ompl.model.query import Query
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.motion_optimizer import InitialMotion, shortest_duration
from apex_ompl.moving.search import STATES, Search, Source, fresh_checker, place_nearest, rest_of_route
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.optimizer import PERTURBATION_SIZE, Optimizer
from apex_ompl.paths.path import SEARCH_RESOLUTION, resample
from apex_ompl.types import Array

FASTER = (0.92, 0.8)  # shares of the duration of a motion that a faster one may have
TEMPERATURES = (1.0, 1.6)  # temperatures of the noise, by turns of replans
BATCH = 16  # random states between two checks of the budget
WORK = "state of a tree"


@dataclass(frozen=True)
class Route(Source):
    """The remaining part of the last motion to a goal."""

    name: str = "route"

    def initial_motions(self, search: Search) -> Iterator[InitialMotion]:
        """Yield the rest of the route, where there is one."""
        rest = rest_of_route(search)
        if rest is not None:
            yield InitialMotion(rest, rest[-1], shortest_duration(rest, search.context.limits))


@dataclass(frozen=True)
class Faster(Source):
    """The remaining motion, faster."""

    name: str = "faster"

    def initial_motions(self, search: Search) -> Iterator[InitialMotion]:
        """Yield the rest of the motion, where it has no conflict."""
        request = search.request
        left = request.following.end - request.join
        if request.hastens and left > 0.0:
            times = request.join - request.following.start_time + np.linspace(0.0, left, STATES)
            states = request.following.motion(np.clip(times, 0.0, request.following.motion.duration))
            for factor in FASTER:
                yield InitialMotion(states, request.following.motion.positions[-1], factor * left, timed=True)


@dataclass(frozen=True)
class Lines(Source):
    """Straight lines to the nearest goals, or random perturbations of them.

    Attributes:
        perturbed: Number of perturbed lines for each goal; 0 takes the straight line alone.
        size: Amplitude of the perturbations [rad].
        goals: Number of goals.
    """

    perturbed: int = 0
    size: float = PERTURBATION_SIZE
    goals: int = 2
    name: str = "line"

    def initial_motions(self, search: Search) -> Iterator[InitialMotion]:
        """Yield the lines."""
        optimizer, fingers = Optimizer(), search.context.fingers
        for goal in search.goals[: self.goals]:
            starts = optimizer.starts(search.start.position, goal, 1 + self.perturbed, search.rng, self.size)
            starts[1:, :, fingers] = starts[0, :, fingers].T
            for control in starts[1:] if self.perturbed else starts:
                states = optimizer.spline.path(control)
                yield InitialMotion(states, goal, shortest_duration(states, search.context.limits))


@dataclass(eq=False)
class Proposals:
    """Paths of a latent diffusion model from the state that the robot will have.

    The model was trained among static obstacles. Its scene has each dynamic obstacle where it comes nearest to the
    straight line in time.

    Attributes:
        model: Name or folder of the checkpoint, see :func:`apex_ompl.apex.models.trajectory_model`.
        count: Number of proposals.
    """

    model: str = "auto"
    count: int = 4
    name: str = "proposals"
    _loaded: Model | None = field(default=None, repr=False)
    _checker: CollisionChecker | None = field(default=None, repr=False)

    def prepare(self, context: RunContext) -> None:
        """Load the model, and propose something.

        Raises:
            ApexError: The checkpoint cannot be loaded, or is of another robot.
        """
        setup = context.setup
        self._loaded, self._checker = trajectory_model(self.model, setup.robot), fresh_checker(context)
        query = make_query(self._checker, setup.start, setup.start, point=self._loaded.sees_point)
        with self._loaded.one_thread():
            self._loaded.propose(query, self._checker.kernel, self.count)

    @property
    def model_and_checker(self) -> tuple[Model, CollisionChecker]:
        """The model and the checker of its scene, after :meth:`prepare`."""
        assert self._loaded is not None and self._checker is not None
        return self._loaded, self._checker

    def initial_motions(self, search: Search) -> Iterator[InitialMotion]:
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
            yield InitialMotion(states, goal, shortest_duration(states, search.context.limits))

    def _made(self, search: Search, query: Query) -> Array:
        """Return control points of proposals, shape (B, points, dof)."""
        model, checker = self.model_and_checker
        temperature = TEMPERATURES[search.request.number % len(TEMPERATURES)]
        sampling = model.sampling
        made = model.propose(
            query, checker.kernel, self.count, generator=search.rng,
            sampling=type(sampling)(sampling.sampler, sampling.steps, temperature, sampling.guidance),
        )  # fmt: skip
        search.budget.spend("proposals")
        search.budget.spend("proposal", self.count)
        return made.control


@dataclass(eq=False)
class Renoised(Proposals):
    """The remaining motion to a goal, noised and denoised again: the paper's resampling while the robot moves.

    Attributes:
        noises: Noise levels as shares of the schedule, by turns of replans.
    """

    name: str = "renoise"
    noises: tuple[float, ...] = (0.15, 0.4)

    def _made(self, search: Search, query: Query) -> Array:
        rest = rest_of_route(search)
        model, checker = self.model_and_checker
        if rest is None:
            return np.empty((0, 0, 0))
        rest = rest + (search.start.position - rest[0]) * np.linspace(1.0, 0.0, len(rest))[:, None]
        limits = search.context.limits
        control = model.spline.fit(rest, limits.lower, limits.upper).control
        noise = self.noises[search.request.number % len(self.noises)]
        made = model.renoise(
            query, checker.kernel, np.repeat(control[None], self.count, axis=0),
            max(0, round(noise * model.schedule.steps) - 1), generator=search.rng,
        )  # fmt: skip
        search.budget.spend("proposals")
        search.budget.spend("proposal", self.count)
        return made.control


@dataclass(eq=False)
class Sprint:
    """RRT-Connect in compiled code, for a robot at rest, from the second replan of a run on.

    Its paths are longer than those of other sources, so that the first replan does without. Each dynamic obstacle is
    placed where it comes nearest to the straight line in time; there is no search where it touches the start there.

    Attributes:
        longest: Longest step of the trees [rad].
        most: Largest number of random states.
    """

    longest: float = float(TUNED["apex"]["range"])
    most: int = 1024
    name: str = "sprint"
    _checker: CollisionChecker | None = field(default=None, repr=False)

    def prepare(self, context: RunContext) -> None:
        """Set up a checker of its own."""
        self._checker = fresh_checker(context)

    def initial_motions(self, search: Search) -> Iterator[InitialMotion]:
        """Yield the path of the trees, where they meet in time."""
        assert self._checker is not None
        request = search.request
        if not len(search.goals) or request.number == 1 or not request.following.at_rest(request.join):
            return
        place_nearest(self._checker, search, search.goals[0])
        start = search.start.position
        free = self._checker.are_free(np.concatenate([start[None], search.goals]))
        search.budget.spend(WORK, len(free))
        goals = search.goals[free[1:]]
        if not free[0] or not len(goals):
            return
        trees = TreePair(self._checker.kernel, start[None], goals, self.longest, SEARCH_RESOLUTION, search.rng)
        for _ in range(0, self.most, BATCH):
            path = trees.grow(BATCH)
            counts = trees.take_counts()
            search.budget.spend(WORK, counts.proved + counts.blocked + counts.intervals)
            if path is not None:
                states = resample(path, STATES)
                yield InitialMotion(states, path[-1], shortest_duration(states, search.context.limits))
                return
            if search.budget.over():
                return
