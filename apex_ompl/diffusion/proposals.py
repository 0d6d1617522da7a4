"""A trained model as planners use it: candidate paths for a query."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from apex_ompl.diffusion.conditions import Conditions, Probes, Query, batch_queries
from apex_ompl.diffusion.guidance import Guidance, gradient, guided, log_likelihood
from apex_ompl.diffusion.model import LatentDiffusion
from apex_ompl.diffusion.sampler import SAMPLERS, Callback, ddpm, noise_like
from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.kernel import Kernel
from apex_ompl.trajopt.spline import Spline
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_integer, check_number

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

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            UnknownNameError: There is no such sampler.
            ParameterError: A number is out of range.
        """
        if self.sampler not in SAMPLERS:
            raise UnknownNameError("sampler", self.sampler, SAMPLERS)
        check_integer(self.steps, "number of denoising steps", 1)
        check_number(self.temperature, "temperature", 0.0)


@dataclass(frozen=True, eq=False)
class Proposals:
    """Proposed paths, not checked for collisions.

    Attributes:
        control: Control points, shape (B, points, dof) [rad], inside the limits; ends are start and goal bit for bit.
        latent: Latent vectors, shape (B, *latent).
        seconds: Time by stage: ``condition``, ``network``, ``guidance``, ``decode`` [s].
    """

    control: Array
    latent: Tensor
    seconds: Mapping[str, float]


class TrajectoryModel:
    """Trained model that proposes paths; safe to use from several threads.

    Attributes:
        network: The networks.
        about: Record of the training.
        spline: Spline of the control points.
        sampling: Default sampling.
    """

    def __init__(self, network: LatentDiffusion, about: Mapping[str, Any]) -> None:
        """Use a network with its present weights; they are frozen."""
        self.network = network.eval().requires_grad_(False)
        self.about = dict(about)
        self.spline: Spline = network.autoencoder.spline
        joint, offset = network.probe_joint.cpu().numpy(), network.probe_offset.cpu().double().numpy()
        self.probes = Probes(joint, offset, network.config.condition.along)
        self.sampling = Sampling(**network.config.sampling.model_dump())

    @property
    def sees_point(self) -> bool:
        """Whether it looks at the obstacle point of a query."""
        return self.network.config.condition.point

    @property
    def device(self) -> torch.device:
        """Where it runs."""
        return self.network.probe_offset.device

    def propose(
        self, query: Query | Sequence[Query], kernel: Kernel, count: int, *, sampling: Sampling | None = None,
        generator: torch.Generator | None = None, callback: Callback | None = None,
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
        shape = torch.zeros(len(queries) * count, *self.network.latent, device=self.device)
        generator = generator or torch.Generator().manual_seed(0)
        first = sampling.temperature * noise_like(shape, generator)
        top = self.network.schedule.steps - 1
        return self._denoised(queries, kernel, first, top, sampling=sampling, generator=generator, callback=callback)

    def renoise(
        self, query: Query, kernel: Kernel, control: Array, step: int, *, sampling: Sampling | None = None,
        generator: torch.Generator | None = None, callback: Callback | None = None,
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
        shape = ("B", self.spline.points, len(self.network.config.joints))
        check_array(control, shape, "control points", finite=True)
        check_integer(step, "step", 0, self.network.schedule.steps - 1)
        generator = generator or torch.Generator().manual_seed(0)
        with torch.no_grad():
            clean = self.network.autoencoder.encode(torch.tensor(control, dtype=torch.float32, device=self.device))
            first = self.network.schedule.add_noise(clean, noise_like(clean, generator), step)
        sampling = replace(sampling, steps=min(sampling.steps, step + 1))
        return self._denoised([query], kernel, first, step, sampling=sampling, generator=generator, callback=callback)

    def conditions(self, queries: Sequence[Query], kernel: Kernel) -> Conditions:
        """Return queries as a batch on the model's device.

        Raises:
            ParameterError: The robot is not the model's, or numbers are not finite.
        """
        config = self.network.config
        if (kernel.robot.name, kernel.robot.joint_names) != (config.robot, config.joints):
            raise ParameterError("robot", kernel.robot.name, f"{config.robot}, which the model was trained for")
        for query in queries:
            for name, state in (("start", query.start), ("goal", query.goal)):
                check_array(np.asarray(state, float), (len(config.joints),), name, finite=True)
            obstacles = query.obstacles
            numbers = (query.point, obstacles.position, obstacles.rotation, obstacles.size)
            if not all(np.isfinite(values).all() for values in numbers):
                raise ParameterError("obstacles", "NaN or infinity", "finite positions, rotations and sizes")
        return batch_queries(queries, self.probes, kernel).to(self.device)

    def _denoised(
        self, queries: Sequence[Query], kernel: Kernel, first: Tensor, top: int, *, sampling: Sampling,
        generator: torch.Generator, callback: Callback | None,
    ) -> Proposals:  # fmt: skip
        """Return the paths that the reverse process makes of noisy latent vectors ``first`` at step ``top``."""
        network, clock = self.network, _StageClock()
        with torch.no_grad():
            conditions, each = self.conditions(queries, kernel), len(first) // len(queries)
            encoded = network.encoder(conditions)
            if len(queries) > 1:
                encoded = encoded.repeat_interleave(each, dim=0)
            start, goal = (ends.repeat_interleave(each, dim=0) for ends in (conditions.start, conditions.goal))
            clock.lap("condition")
            if network.is_regression:
                zero = torch.zeros_like(first)
                latent = network.denoise(zero, torch.zeros(1, dtype=torch.int64, device=zero.device), encoded)
            else:

                def log_p(clean: Tensor) -> Tensor:
                    return log_likelihood(network.autoencoder, kernel, clean, (start, goal), sampling.guidance)

                def score(clean: Tensor) -> Tensor:
                    with clock.within("guidance"):
                        return gradient(log_p, clean)

                most = network.config.noise.most
                predict = guided(network.predict(encoded), score, network.schedule, sampling.guidance, most)
                times = network.schedule.timesteps(sampling.steps, top)
                extra: dict[str, Any] = {} if callback is None else {"callback": callback}
                if sampling.sampler == "ddpm":
                    latent = ddpm(predict, first, network.schedule, times, generator=generator, **extra)
                else:
                    latent = SAMPLERS[sampling.sampler](predict, first, network.schedule, times, **extra)
            clock.lap("network")
            control = network.autoencoder.control(latent, start, goal).cpu().double().numpy()
            limits = kernel.robot.arrays
            ends = (np.repeat([getattr(q, name) for q in queries], each, axis=0) for name in ("start", "goal"))
            control = self.spline.with_ends(np.clip(control, limits.lower, limits.upper), *ends)
            clock.lap("decode")
        return Proposals(control, latent, clock.seconds)


class _StageClock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds = {"condition": 0.0, "network": 0.0, "guidance": 0.0, "decode": 0.0}
        self._last, self._inside = time.perf_counter(), 0.0

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage, less what :meth:`within` added to others."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last - self._inside
        self._last, self._inside = now, 0.0

    @contextmanager
    def within(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage, and not to the one that the next lap ends."""
        started = time.perf_counter()
        yield
        passed = time.perf_counter() - started
        self.seconds[stage] += passed
        self._inside += passed
