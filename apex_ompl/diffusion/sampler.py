"""Reverse processes: from noise to samples, as plain functions that call back at every step."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from apex_ompl.diffusion.schedule import Estimate, NoiseSchedule
from apex_ompl.errors import ParameterError

Predict = Callable[[Tensor, int], Estimate]
"""Says of samples of shape (B, ...) at a step what they are made of."""

Callback = Callable[[int, Tensor, Estimate], None]
"""Called at each step with its number, the noisy samples and what they are made of."""


def _silent(t: int, sample: Tensor, estimate: Estimate) -> None:
    del t, sample, estimate


def ddpm(
    predict: Predict, sample: Tensor, schedule: NoiseSchedule, times: Sequence[int], *,
    generator: torch.Generator | None = None, callback: Callback = _silent,
) -> Tensor:  # fmt: skip
    """Denoise step by step, with fresh noise at each (ancestral sampling, equation 3; Ho et al. 2020).

    The mean is the posterior's, given the clean sample that the network sees; the variance is the posterior's too.

    Args:
        predict: The network.
        sample: Noisy samples, shape (B, ...).
        schedule: The noise schedule.
        times: Steps, falling; all of them in the paper.
        generator: Source of the noise.
        callback: Called at every step.
    """
    left = schedule.alpha_bar
    for t, following in _pairs(times):
        estimate = predict(sample, t)
        callback(t, sample, estimate)
        now = float(left[t])
        before = float(left[following]) if following >= 0 else 1.0
        kept = now / before
        mean = (before**0.5 * (1.0 - kept) * estimate.clean + kept**0.5 * (1.0 - before) * sample) / (1.0 - now)
        spread = ((1.0 - before) / (1.0 - now) * (1.0 - kept)) ** 0.5
        sample = mean + spread * noise_like(sample, generator) if following >= 0 else mean
    return sample


def ddim(
    predict: Predict, sample: Tensor, schedule: NoiseSchedule, times: Sequence[int], *, callback: Callback = _silent
) -> Tensor:
    """Denoise without fresh noise (Song, Meng and Ermon 2021); arguments as in :func:`ddpm`."""
    for t, following in _pairs(times):
        estimate = predict(sample, t)
        callback(t, sample, estimate)
        if following < 0:
            return estimate.clean
        signal, sigma = schedule.scale(following)
        sample = signal * estimate.clean + sigma * estimate.noise
    return sample


def dpm_solver(
    predict: Predict, sample: Tensor, schedule: NoiseSchedule, times: Sequence[int], *, callback: Callback = _silent
) -> Tensor:
    """Denoise by the second-order multistep solver DPM-Solver++(2M) (Lu et al. 2022); arguments as in :func:`ddpm`.

    The first step, and the last one to the clean sample, are of first order.
    """
    left = schedule.alpha_bar
    half_logs = (0.5 * (left.log() - (1.0 - left).log())).tolist()
    last: tuple[float, Tensor] | None = None
    for t, following in _pairs(times):
        estimate = predict(sample, t)
        callback(t, sample, estimate)
        if following < 0:
            return estimate.clean
        step = half_logs[following] - half_logs[t]
        clean = estimate.clean
        if last is not None:
            clean = clean + step / (2.0 * last[0]) * (clean - last[1])
        last = step, estimate.clean
        signal, sigma = schedule.scale(following)
        sample = sigma / schedule.scale(t)[1] * sample - signal * math.expm1(-step) * clean
    return sample


SAMPLERS = {"ddpm": ddpm, "ddim": ddim, "dpm_solver": dpm_solver}
"""By name."""


def noise_like(sample: Tensor, generator: torch.Generator | None) -> Tensor:
    """Return standard normal numbers of a sample's shape; drawn on the generator's device, so that they repeat."""
    device = generator.device if generator is not None else sample.device
    return torch.randn(sample.shape, generator=generator, device=device, dtype=sample.dtype).to(sample.device)


def _pairs(times: Sequence[int]) -> list[tuple[int, int]]:
    """Return each step with the one that follows, -1 behind the last.

    Raises:
        ParameterError: They do not fall.
    """
    chain = [*times, -1]
    if any(a <= b for a, b in zip(chain, chain[1:], strict=False)):
        raise ParameterError("times", list(times), "steps that fall, none below 0")
    return list(zip(chain[:-1], chain[1:], strict=True))
