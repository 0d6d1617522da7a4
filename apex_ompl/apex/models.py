"""Models of proposals: the checkpoint for a robot, or random perturbations of straight lines; their queries.

Inside of ``solve`` they are sampled by :class:`ProposalSampler`, which ends when time is up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cache

import numpy as np

from apex_ompl.apex.model_search import AUTO, NONE, find_model, robot_fault
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.checker import NO_POINT
from apex_ompl.kernel import Kernel
from apex_ompl.model.checkpoint import shared_model
from apex_ompl.model.diffusion import Callback, Estimate, NoiseSchedule
from apex_ompl.model.geometry import Numbers
from apex_ompl.model.primitive_fit import scene_of_primitives
from apex_ompl.model.proposals import Proposals, Sampling, TrajectoryModel
from apex_ompl.model.query import Query
from apex_ompl.ompl.own_planner import SolveReport
from apex_ompl.paths.optimizer import PERTURBATION_SIZE, Optimizer
from apex_ompl.robot import Robot
from apex_ompl.types import Array


class PerturbationModel:
    """Proposes random perturbations of straight lines, for any robot, by the interface of a trajectory model.

    Attributes:
        spline: Spline of the control points.
        schedule: Noise schedule of one step: a path is not resampled, but drawn anew.
        sampling: Default sampling; the temperature is a factor on the size of the perturbations.
        sees_point: Whether it looks at the obstacle point of a query: it does not.
    """

    def __init__(self) -> None:
        """Propose paths of the optimizer's default spline."""
        self.spline, self.schedule = Optimizer().spline, NoiseSchedule(1)
        self.sampling, self.sees_point = Sampling(steps=1), False

    def one_thread(self) -> AbstractContextManager[None]:
        """Do nothing: there is no network."""
        return nullcontext()

    def propose(
        self, query: Query | Sequence[Query], kernel: Kernel, count: int, *, sampling: Sampling | None = None,
        generator: np.random.Generator | None = None, callback: Callback | None = None,
    ) -> Proposals:  # fmt: skip
        """Return perturbed straight lines for a query, or for several; see ``TrajectoryModel.propose``."""
        queries = [query] if isinstance(query, Query) else list(query)
        rng, size = generator or np.random.default_rng(0), (sampling or self.sampling).temperature * PERTURBATION_SIZE
        optimizer, limits = Optimizer(self.spline), kernel.robot.arrays
        sizes = size / limits.weight
        some = [optimizer.starts(q.start, q.goal, count + 1, rng, sizes)[1:] for q in queries]
        control = np.clip(np.concatenate(some), limits.lower, limits.upper)
        start, goal = (np.repeat([getattr(q, end) for q in queries], count, axis=0) for end in ("start", "goal"))
        return Proposals(self.spline.with_ends(control, start, goal), np.empty(0), {})

    def renoise(
        self, query: Query, kernel: Kernel, control: Array, step: int, *, sampling: Sampling | None = None,
        generator: np.random.Generator | None = None, callback: Callback | None = None,
    ) -> Proposals:  # fmt: skip
        """Return other perturbed lines in place of given paths; see ``TrajectoryModel.renoise``."""
        return self.propose(query, kernel, len(control), sampling=sampling, generator=generator)


Model = TrajectoryModel | PerturbationModel
"""A model of proposals."""


@cache
def _perturbations() -> PerturbationModel:
    """Return the one of this process: it keeps nothing."""
    return PerturbationModel()


def trajectory_model(name: str, robot: Robot, device: str = "cpu") -> Model:
    """Return a checkpoint's model for a robot, or random perturbations.

    Args:
        name: Name or folder of a checkpoint; ``auto`` takes the one that :func:`find_model` finds, or ``none`` where
            there is none: random perturbations of straight lines.
        robot: The robot.
        device: Where a network runs.

    Raises:
        ApexError: The checkpoint cannot be loaded, or is of another robot.
    """
    name = find_model(robot).name if name == AUTO else name
    if name == NONE:
        return _perturbations()
    fault = robot_fault(name, robot)
    if fault is not None:
        raise fault
    return shared_model(name, device=device, robot=robot.name)


def make_query(checker: CollisionChecker, start: Array, goal: Array, *, point: bool = True) -> Query:
    """Return the query of going from a state to another, among the obstacles of now.

    Fixtures of the robot are left out. As ``obstacles``, meshes and points are the primitives that they look like.

    Args:
        checker: The robot among obstacles.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        point: Whether the obstacle point is looked for; models that do not see it can do without.
    """
    scene, movable = checker.kernel.scene, checker.movable
    nearest = checker.obstacle_point(start) if point else np.array(NO_POINT)
    ends = np.asarray(start, float), np.asarray(goal, float)
    return Query(*ends, nearest, None, (scene, movable), checker.held_extents)


def rough_kernel(kernel: Kernel) -> Kernel | None:
    """Return the robot among primitives that look like its obstacles; None where these are primitives themselves."""
    scene = scene_of_primitives(kernel.scene)
    return None if scene is None else Kernel(kernel.robot, scene)


Stop = Callable[[], bool]


class OutOfTimeError(Exception):
    """Raised inside of a sampler to leave it; never leaves this module."""


class ProposalSampler:
    """Proposals of a trajectory model among the obstacles of a kernel.

    Attributes:
        model: The trajectory model.
        sampling: How proposals are denoised, guidance included.
    """

    def __init__(
        self, model: Model, kernel: Kernel, sampling: Sampling, *,
        generator: np.random.Generator, stop: Stop, report: SolveReport,
    ) -> None:  # fmt: skip
        """Sample from ``model``.

        Args:
            model: The trajectory model.
            kernel: The robot among its obstacles.
            sampling: How proposals are denoised.
            generator: Source of all noise.
            stop: Asked at every denoising step whether time is up.
            report: Gets the time of guidance.
        """
        self.model, self.sampling = model, sampling
        self._kernel, self._generator, self._stop, self._report = kernel, generator, stop, report

    def propose(self, queries: Sequence[Query], count: int, temperature: float = 1.0) -> Array | None:
        """Return control points of new proposals, shape (B, points, dof); None when time ended.

        Args:
            queries: What they are conditioned on.
            count: Their number for each query.
            temperature: Factor on the standard deviation of the initial noise.
        """
        sampling = replace(self.sampling, temperature=temperature * self.sampling.temperature)
        return self._sampled(
            lambda: self.model.propose(
                queries, self._kernel, count, sampling=sampling, generator=self._generator, callback=self._leave
            )
        )

    def renoise(self, control: Array, query: Query, noise: float) -> Array | None:
        """Return paths that are noised part of the way and denoised again (resampling, section III-C of the paper).

        Args:
            control: Control points of the paths, shape (B, points, dof).
            query: Their start and goal.
            noise: How far they are noised, as a share of the schedule.

        Returns:
            Control points, shape (B, points, dof); None when time ended.
        """
        step = max(0, round(noise * self.model.schedule.steps) - 1)
        return self._sampled(
            lambda: self.model.renoise(
                query, self._kernel, control, step, sampling=self.sampling, generator=self._generator,
                callback=self._leave,
            )
        )  # fmt: skip

    def _sampled(self, sample: Callable[[], Proposals]) -> Array | None:
        try:
            proposals = sample()
        except OutOfTimeError:
            return None
        times, guidance = self._report.times, proposals.seconds.get("guidance", 0.0)
        if guidance:
            times["guidance"] = times.get("guidance", 0.0) + guidance
        return proposals.control

    def _leave(self, step: int, latent: Numbers, estimate: Estimate) -> None:
        """Leave the sampler when time is up; called at every denoising step."""
        if self._stop():
            raise OutOfTimeError
