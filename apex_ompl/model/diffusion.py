"""Gaussian diffusion: the noise schedule, and reverse processes from noise to samples.

A noisy sample at step t is drawn from q(z_t | z_0) = N(sqrt(abar_t) z_0, (1 - abar_t) I) (equation 2 of the paper), so
z_t = sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon. Samplers are plain functions of arrays or tensors with a callback at
each step. In their formulas z_0 and epsilon are the network's estimates, and s is the step after t, with abar_s = 1
after the last step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.model.geometry import Numbers, array_module
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_name

SCHEDULES = ("cosine", "linear")
PREDICTIONS = ("noise", "velocity", "clean")
MAX_BETA = 0.999  # largest variance of a step, as Nichol and Dhariwal (2021) cap it


class Estimate(NamedTuple):
    """Noise and clean sample of a noisy sample, as a network estimates them.

    Attributes:
        noise: Noise epsilon, of the sample's shape.
        clean: Clean sample z_0, of the sample's shape.
    """

    noise: Numbers
    clean: Numbers


Predict = Callable[[Numbers, int], Estimate]
"""Denoiser: return the estimated noise and clean samples of noisy samples, shape (B, ...), at a step."""

Callback = Callable[[int, Numbers, Estimate], None]
"""Called at each step with its number, the noisy samples and the denoiser's estimate."""


@dataclass(frozen=True)
class NoiseSchedule:
    """Noise schedule of T steps, t = 0 ... T - 1.

    ``linear`` is that of Ho et al. (2020): beta from 1e-4 to 0.02, times 1000 / T, so that T steps add the noise of
    their 1000. ``cosine`` is that of Nichol and Dhariwal (2021): abar(u) proportional to
    cos^2((u + 0.008) / 1.008 * pi / 2), u = t / T.

    Attributes:
        steps: Number of steps T.
        kind: ``cosine`` or ``linear``.
    """

    steps: int = 256
    kind: str = "cosine"

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: There are no steps.
            UnknownNameError: No such schedule.
        """
        check_integer(self.steps, "steps", 1)
        check_name(self.kind, "noise schedule", SCHEDULES)

    @cached_property
    def betas(self) -> Array:
        """Variances beta_t of the noise that each step adds, shape (steps,)."""
        if self.kind == "linear":
            scale = 1000.0 / self.steps
            return np.asarray(np.linspace(1e-4 * scale, 0.02 * scale, self.steps).clip(max=MAX_BETA))
        at = np.arange(self.steps + 1) / self.steps
        alpha_bar = np.cos((at + 0.008) / 1.008 * math.pi / 2) ** 2
        return np.asarray(np.minimum(1.0 - alpha_bar[1:] / alpha_bar[:-1], MAX_BETA))

    @cached_property
    def alpha_bar(self) -> Array:
        """Products abar_t of 1 - beta up to each step, shape (steps,)."""
        return np.asarray(np.cumprod(1.0 - self.betas))

    def scale(self, t: int) -> tuple[float, float]:
        """Return sqrt(abar_t) and sqrt(1 - abar_t) at one step."""
        return self._scales[t]

    @cached_property
    def _scales(self) -> list[tuple[float, float]]:
        return list(zip(np.sqrt(self.alpha_bar).tolist(), np.sqrt(1.0 - self.alpha_bar).tolist(), strict=True))

    def add_noise(self, clean: Numbers, noise: Numbers, t: int) -> Numbers:
        """Return noisy samples sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon (equation 2) at a step."""
        signal, sigma = self.scale(t)
        return signal * clean + sigma * noise

    def estimate(self, prediction: str, sample: Numbers, output: Numbers, t: int) -> Estimate:
        """Return noise and clean sample from a network's output for a noisy sample.

        The output is epsilon (equation 5) for ``noise`` and z_0 for ``clean``. For ``velocity`` it is
        v = sqrt(abar_t) epsilon - sqrt(1 - abar_t) z_0 (Salimans and Ho 2022).
        """
        signal, sigma = self.scale(t)
        if prediction == "noise":
            return Estimate(output, (sample - sigma * output) / signal)
        if prediction == "clean":
            return Estimate((sample - signal * output) / sigma, output)
        return Estimate(sigma * sample + signal * output, signal * sample - sigma * output)

    def clipped(self, estimate: Estimate, sample: Numbers, t: int, most: float | None) -> Estimate:
        """Return an estimate with its clean sample clipped to [-most, most], and the noise recomputed where it was."""
        if most is None:
            return estimate
        signal, sigma = self.scale(t)
        clean, where = estimate.clean.clip(-most, most), array_module(sample).where
        return Estimate(where(clean == estimate.clean, estimate.noise, (sample - signal * clean) / sigma), clean)

    def timesteps(self, count: int, first: int | None = None) -> list[int]:
        """Return ``count`` denoising steps, evenly spaced from ``first`` down ("trailing" spacing, Lin et al. 2024).

        Args:
            count: Number of steps, at most ``first`` + 1.
            first: The noisiest step; by default T - 1.

        Raises:
            ParameterError: There are fewer steps, or no such step.
        """
        top = self.steps - 1 if first is None else first
        check_integer(top, "first step", 0, self.steps - 1)
        check_integer(count, "number of denoising steps", 1, top + 1)
        return [round((top + 1) * (1.0 - k / count)) - 1 for k in range(count)]


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
    """Return each step with the step after it, -1 after the last.

    Raises:
        ParameterError: The steps do not descend.
    """
    chain = [*times, -1]
    if any(a <= b for a, b in zip(chain, chain[1:], strict=False)):
        raise ParameterError("times", list(times), "descending steps, none below 0")
    return list(zip(chain[:-1], chain[1:], strict=True))
