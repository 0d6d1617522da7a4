"""Proposals inside ``solve``: sampling that ends when time is up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from apex_ompl.apex.models import Model
from apex_ompl.kernel import Kernel
from apex_ompl.model.diffusion import Estimate
from apex_ompl.model.geometry import Numbers
from apex_ompl.model.proposals import Proposals, Sampling
from apex_ompl.model.query import Query
from apex_ompl.ompl.own_planner import SolveReport
from apex_ompl.types import Array

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
