"""Reverse processes: from noise to samples, of arrays or tensors, as plain functions with a callback at each step.

Notation: z_t is the noisy sample at step t, z_0 and epsilon its clean sample and noise as the network estimates them,
abar_t the schedule's ``alpha_bar``, s the step that follows t (abar = 1 behind the last one).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.model.geometry import Numbers
from apex_ompl.model.schedule import Estimate, NoiseSchedule

Predict = Callable[[Numbers, int], Estimate]
"""Denoiser: return the estimated noise and clean samples of noisy samples, shape (B, ...), at a step."""

Callback = Callable[[int, Numbers, Estimate], None]
"""Called at each step with its number, the noisy samples and the denoiser's estimate."""


def _no_callback(t: int, sample: Numbers, estimate: Estimate) -> None:
    del t, sample, estimate


def ddpm(
    predict: Predict, sample: Numbers, schedule: NoiseSchedule, times: Sequence[int], *,
    generator: np.random.Generator | None = None, callback: Callback = _no_callback,
) -> Numbers:  # fmt: skip
    """Return samples of ancestral sampling, with fresh noise at each step (equation 3 of the paper; Ho et al. 2020).

    The next sample is drawn from the posterior q(z_s | z_t, z_0) = N(mean, variance), with alpha = abar_t / abar_s:

    - mean = (sqrt(abar_s) (1 - alpha) z_0 + sqrt(alpha) (1 - abar_s) z_t) / (1 - abar_t)
    - variance = (1 - abar_s) / (1 - abar_t) (1 - alpha)

    Args:
        predict: The denoiser.
        sample: Noisy samples at the first step, shape (B, ...).
        schedule: The noise schedule.
        times: Steps, descending; all of them in the paper.
        generator: Source of the noise.
        callback: Called at each step.
    """
    alpha_bars = schedule.alpha_bar
    for t, following in _pairs(times):
        estimate = predict(sample, t)
        callback(t, sample, estimate)
        here = float(alpha_bars[t])
        after = float(alpha_bars[following]) if following >= 0 else 1.0
        alpha = here / after
        mean = (after**0.5 * (1.0 - alpha) * estimate.clean + alpha**0.5 * (1.0 - after) * sample) / (1.0 - here)
        deviation = ((1.0 - after) / (1.0 - here) * (1.0 - alpha)) ** 0.5
        sample = mean + deviation * noise_like(sample, generator) if following >= 0 else mean
    return sample


def ddim(
    predict: Predict, sample: Numbers, schedule: NoiseSchedule, times: Sequence[int], *,
    callback: Callback = _no_callback,
) -> Numbers:  # fmt: skip
    """Return samples of the deterministic sampler DDIM (Song, Meng and Ermon 2021); arguments as in :func:`ddpm`.

    z_s = sqrt(abar_s) z_0 + sqrt(1 - abar_s) epsilon
    """
    for t, following in _pairs(times):
        estimate = predict(sample, t)
        callback(t, sample, estimate)
        if following < 0:
            return estimate.clean
        signal, sigma = schedule.scale(following)
        sample = signal * estimate.clean + sigma * estimate.noise
    return sample


def dpm_solver(
    predict: Predict, sample: Numbers, schedule: NoiseSchedule, times: Sequence[int], *,
    callback: Callback = _no_callback,
) -> Numbers:  # fmt: skip
    """Return samples of the second-order multistep solver DPM-Solver++(2M) (Lu et al. 2022).

    Arguments are those of :func:`ddpm`. With lambda = log(sqrt(abar) / sqrt(1 - abar)), h = lambda_s - lambda_t, and
    h' and z_0' those of the step before:

    - D = z_0 + h / (2 h') (z_0 - z_0')
    - z_s = sigma_s / sigma_t z_t - sqrt(abar_s) (exp(-h) - 1) D

    The first step, and the last one to the clean sample, are of first order (D = z_0).
    """
    alpha_bars = schedule.alpha_bar
    lambdas = (0.5 * (np.log(alpha_bars) - np.log1p(-alpha_bars))).tolist()
    previous: tuple[float, Numbers] | None = None
    for t, following in _pairs(times):
        estimate = predict(sample, t)
        callback(t, sample, estimate)
        if following < 0:
            return estimate.clean
        step = lambdas[following] - lambdas[t]
        clean = estimate.clean
        if previous is not None:
            clean = clean + step / (2.0 * previous[0]) * (clean - previous[1])
        previous = step, estimate.clean
        signal, sigma = schedule.scale(following)
        sample = sigma / schedule.scale(t)[1] * sample - signal * math.expm1(-step) * clean
    return sample


SAMPLERS = {"ddpm": ddpm, "ddim": ddim, "dpm_solver": dpm_solver}
"""Samplers by name."""


def noise_like(sample: Numbers, generator: np.random.Generator | None) -> Numbers:
    """Return standard normal noise of a sample's shape and kind: the same numbers for arrays and tensors."""
    noise = (generator or np.random.default_rng()).standard_normal(tuple(sample.shape), np.float32)
    if isinstance(sample, np.ndarray):
        return noise.astype(sample.dtype, copy=False)
    return sample.new_tensor(noise)


def _pairs(times: Sequence[int]) -> list[tuple[int, int]]:
    """Return each step with the one that follows, -1 behind the last.

    Raises:
        ParameterError: The steps do not descend.
    """
    chain = [*times, -1]
    if any(a <= b for a, b in zip(chain, chain[1:], strict=False)):
        raise ParameterError("times", list(times), "descending steps, none below 0")
    return list(zip(chain[:-1], chain[1:], strict=True))
