"""Proposals of a trained model: candidate paths for a query."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.kernel.products import product
from apex_ompl.model.config import ModelConfig
from apex_ompl.model.diffusion import SAMPLERS, Callback, Estimate, NoiseSchedule, Predict, ddpm, noise_like
from apex_ompl.model.geometry import Numbers
from apex_ompl.model.guidance import Guidance, guided
from apex_ompl.model.query import Probes, Query, turned_back
from apex_ompl.model.scene_encoding import KeyStates, encoding_of
from apex_ompl.paths.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.clocks import StageClock
from apex_ompl.util.display import counted, fields_line, one_line
from apex_ompl.util.validation import check_array, check_integer, check_name, check_number

UNGUIDED = Guidance(gamma=0.0)


@dataclass(frozen=True)
class Sampling:
    """Parameters of sampling.

    Attributes:
        sampler: ``ddim``, ``dpm_solver`` or ``ddpm``.
        steps: Number of denoising steps; the paper takes all 256 by ``ddpm``.
        temperature: Standard deviation of the initial noise; below 1, paths are more likely and less diverse.
        guidance: Obstacle guidance; none by default.
    """

    sampler: str = "ddim"
    steps: int = 2
    temperature: float = 1.0
    guidance: Guidance = UNGUIDED

    __repr__ = fields_line

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            UnknownNameError: There is no such sampler.
            ParameterError: A number is out of range.
        """
        check_name(self.sampler, "sampler", SAMPLERS)
        check_integer(self.steps, "number of denoising steps", 1)
        check_number(self.temperature, "temperature", 0.0)


@dataclass(frozen=True, eq=False)
class Proposals:
    """Proposed paths, not checked for collisions.

    Attributes:
        control: Control points, shape (B, points, dof) [rad], inside the limits; ends are start and goal bit for bit.
        latent: Latent vectors, shape (B, *latent), arrays or tensors as the model computes.
        seconds: Time by stage: ``condition``, ``network``, ``guidance``, ``decode`` [s].
    """

    control: Array
    latent: Numbers
    seconds: Mapping[str, float]

    __repr__ = fields_line


class TrajectoryModel(ABC):
    """Trained model that proposes paths; safe to use from several threads.

    Attributes:
        config: Configuration.
        about: Record of the training.
        spline: Spline of the control points.
        schedule: Noise schedule.
        probes: Points of the robot whose distances to the obstacles are features.
        scene_encoding: Features of a scene ``clearances``; None for other scenes.
        sampling: Default sampling.
    """

    def __init__(
        self, config: ModelConfig, about: Mapping[str, Any], probes: Probes, keys: Mapping[str, NDArray[Any]]
    ) -> None:
        """Make a model of a configuration; ``keys`` are the buffers of its key states, if it has any."""
        self.config, self.about, self.probes = config, dict(about), probes
        self.spline = Spline(**config.spline.model_dump())
        self.schedule = NoiseSchedule(config.noise.steps, config.noise.schedule)
        self.scene_encoding = encoding_of(config.condition, KeyStates.of(**keys), probes) if keys else None
        self.sampling = Sampling(**config.sampling.model_dump())
        self._along_basis = self.spline.basis(probes.shares)

    def __repr__(self) -> str:
        """Return the robot, the size of the paths, and the kind of scene encoding."""
        size = f"{self.spline.points} control points of {counted(len(self.config.joints), 'joint')}"
        scene = f"scene {self.config.condition.scene!r}"
        return one_line(type(self).__name__, f"robot {self.config.robot!r}", size, scene)

    @property
    def sees_point(self) -> bool:
        """Whether it looks at the obstacle point of a query."""
        return self.config.condition.point

    @abstractmethod
    def one_thread(self) -> AbstractContextManager[None]:
        """Limit its networks to one thread inside a block."""

    @abstractmethod
    def zeros(self, count: int) -> Numbers:
        """Return ``count`` latent vectors of zeros."""

    @abstractmethod
    def encode(self, control: Array) -> Numbers:
        """Return the latent vectors of control points, shape (B, points, dof) [rad]."""

    @abstractmethod
    def condition(self, queries: Sequence[Query], kernel: Kernel) -> Numbers:
        """Return the encoded conditions of Q queries, shape (Q, out)."""

    @abstractmethod
    def refine(self, condition: Numbers, along: NDArray[np.float32]) -> Numbers:
        """Return encoded conditions refined by features along estimated paths, shape (B, F)."""

    @abstractmethod
    def denoise(self, latent: Numbers, t: int, condition: Numbers) -> Numbers:
        """Return the denoiser's output for latent vectors at a step, each with its condition, or one for all."""

    @abstractmethod
    def score(self, latent: Numbers, kernel: Kernel, ends: tuple[Array, Array], guidance: Guidance) -> Numbers:
        """Return the gradient of log p(g | z), minus the collision cost of the decoded path, at latent vectors z.

        Args:
            latent: Latent vectors, shape (B, *latent).
            kernel: The robot among its obstacles.
            ends: Starts and goals, each of shape (B, dof) [rad].
            guidance: Margin of the cost, and number of states.
        """

    @abstractmethod
    def control(self, latent: Numbers, ends: tuple[Array, Array]) -> Array:
        """Return control points, shape (B, points, dof) [rad], of latent vectors between starts and goals."""

    def propose(
        self, query: Query | Sequence[Query], kernel: Kernel, count: int, *, sampling: Sampling | None = None,
        generator: np.random.Generator | None = None, callback: Callback | None = None,
    ) -> Proposals:  # fmt: skip
        """Return paths from noise (Algorithm 1 of the paper, generate_traj).

        Args:
            query: A query, or several in one scene.
            kernel: The robot among its obstacles, for the guidance.
            count: Number of paths for each query; those of the first query come first.
            sampling: Parameters of sampling; by default the model's own.
            generator: Source of all noise; the same state gives the same paths. By default one with seed 0.
            callback: Called at every step.

        Raises:
            ParameterError: A query has states of another robot, or ``count`` is not positive.
        """
        sampling, queries = sampling or self.sampling, [query] if isinstance(query, Query) else list(query)
        check_integer(count, "count", 1)
        generator = generator or np.random.default_rng(0)
        first = sampling.temperature * noise_like(self.zeros(len(queries) * count), generator)
        top = self.schedule.steps - 1
        return self._denoised(queries, kernel, first, top, sampling=sampling, generator=generator, callback=callback)

    def renoise(
        self, query: Query, kernel: Kernel, control: Array, step: int, *, sampling: Sampling | None = None,
        generator: np.random.Generator | None = None, callback: Callback | None = None,
    ) -> Proposals:  # fmt: skip
        """Return variations of given paths: noise of a step is added to their latent vectors, and removed again.

        Args:
            query: The query.
            kernel: The robot among its obstacles.
            control: Control points, shape (B, points, dof) [rad].
            step: Step t of the noise that is added, 0 to T - 1.
            sampling: Parameters of sampling; the number of steps is at most ``step + 1``.
            generator: Source of all noise; by default one with seed 0.
            callback: Called at every step.

        Raises:
            ParameterError: Control points have another shape, or there is no such step.
        """
        sampling, control = sampling or self.sampling, np.asarray(control, float)
        check_array(control, ("B", self.spline.points, len(self.config.joints)), "control points", finite=True)
        check_integer(step, "step", 0, self.schedule.steps - 1)
        generator = generator or np.random.default_rng(0)
        clean = self.encode(control)
        first = self.schedule.add_noise(clean, noise_like(clean, generator), step)
        sampling = replace(sampling, steps=min(sampling.steps, step + 1))
        return self._denoised(
            [query], kernel, first, step, sampling=sampling, generator=generator, callback=callback, known=clean
        )

    def _check(self, queries: Sequence[Query], kernel: Kernel) -> None:
        """Check that queries are of the model's robot, with finite numbers.

        Raises:
            ParameterError: They are not.
        """
        config = self.config
        if (kernel.robot.name, kernel.robot.joint_names) != (config.robot, config.joints):
            raise ParameterError("robot", kernel.robot.name, f"{config.robot}, which the model was trained for")
        for query in queries:
            for name, state in (("start", query.start), ("goal", query.goal)):
                check_array(np.asarray(state, float), (len(config.joints),), name, finite=True)
            given = query.known  # a kernel's scene is checked where it is made
            numbers = (query.point, *(() if given is None else (given.position, given.rotation, given.size)))
            if not all(np.isfinite(values).all() for values in numbers):
                raise ParameterError("obstacles", "NaN or infinity", "finite positions, rotations and sizes")

    def _denoised(
        self, queries: Sequence[Query], kernel: Kernel, first: Numbers, top: int, *, sampling: Sampling,
        generator: np.random.Generator, callback: Callback | None, known: Numbers | None = None,
    ) -> Proposals:  # fmt: skip
        """Return the paths that the reverse process makes of noisy latent vectors ``first`` at step ``top``.

        A model that sees its own estimate starts with the paths of ``known`` latent vectors, if there are any.
        """
        self._check(queries, kernel)
        clock, each = StageClock("condition", "network", "guidance", "decode"), len(first) // len(queries)
        start, goal = (np.array([getattr(q, name) for q in queries], float) for name in ("start", "goal"))
        ends = np.repeat(start, each, axis=0), np.repeat(goal, each, axis=0)
        condition = self.condition(turned_back(queries, kernel.robot), kernel)
        if len(queries) > 1:
            condition = condition[np.repeat(np.arange(len(queries)), each)]
        clock.lap("condition")
        if self.config.denoiser.kind == "regression":
            latent = self.denoise(self.zeros(len(first)), 0, condition)
        else:

            def score(clean: Numbers) -> Numbers:
                with clock.within("guidance"):
                    return self.score(clean, kernel, ends, sampling.guidance)

            def refined(clean: Numbers) -> Numbers:
                return self.refine(condition, self._along(queries, kernel, self.control(clean, ends)))

            refine = refined if self.config.condition.refined else None
            predict = self._predict(condition, refine, known)
            predict = guided(predict, score, self.schedule, sampling.guidance, self.config.noise.most)
            times = self.schedule.timesteps(sampling.steps, top)
            extra: dict[str, Any] = {} if callback is None else {"callback": callback}
            if sampling.sampler == "ddpm":
                latent = ddpm(predict, first, self.schedule, times, generator=generator, **extra)
            else:
                latent = SAMPLERS[sampling.sampler](predict, first, self.schedule, times, **extra)
        clock.lap("network")
        limits = kernel.robot.arrays
        control = np.clip(self.control(latent, ends), limits.lower, limits.upper)
        control = self.spline.with_ends(control, *ends)
        clock.lap("decode")
        return Proposals(control, latent, clock.seconds)

    def _along(self, queries: Sequence[Query], kernel: Kernel, control: Array) -> NDArray[np.float32]:
        """Return the features along paths, as many of each query: shape (B, features)."""
        assert self.scene_encoding is not None
        limits, each = kernel.robot.arrays, len(control) // len(queries)
        paths = product(self._along_basis, np.clip(control, limits.lower, limits.upper))
        rows = [
            self.scene_encoding.along(kernel, paths[k * each : (k + 1) * each], *query.obstacle_tables())
            for k, query in enumerate(queries)
        ]
        return np.concatenate(rows)

    def _predict(
        self, condition: Numbers, refine: Callable[[Numbers], Numbers] | None, known: Numbers | None
    ) -> Predict:
        """Return the denoiser as samplers call it.

        Args:
            condition: Encoded conditions.
            refine: For a model that sees its estimates, returns conditions refined by features along their paths.
            known: Clean samples that take the place of the first estimate.
        """
        noise, last = self.config.noise, known

        def predict(sample: Numbers, t: int) -> Estimate:
            nonlocal last
            refined = condition if refine is None or last is None else refine(last)
            output = self.denoise(sample, t, refined)
            estimate = self.schedule.estimate(noise.prediction, sample, output, t)
            last = estimate.clean
            return self.schedule.clipped(estimate, sample, t, noise.most)

        return predict
