"""Noise schedule of Gaussian diffusion (equation 2 of the paper), and the quantity that a network predicts.

q(z_t | z_0) = N(sqrt(abar_t) z_0, (1 - abar_t) I), so z_t = sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apex_ompl.model.geometry import Numbers, array_module
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_name

if TYPE_CHECKING:
    from torch import Tensor

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
    _known: dict[Any, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

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

    def scales(self, t: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return sqrt(abar_t) and sqrt(1 - abar_t) at steps (B,), in a shape that multiplies tensors like ``like``."""
        if like.device not in self._known:
            known = np.sqrt(np.stack([self.alpha_bar, 1.0 - self.alpha_bar]))
            self._known[like.device] = like.double().new_tensor(known)
        signal, sigma = (
            self._known[like.device][:, t.to(like.device)]
            .to(like.dtype)
            .reshape(2, *t.shape, *[1] * (like.ndim - t.ndim))
        )
        return signal, sigma

    def scale(self, t: int) -> tuple[float, float]:
        """Return sqrt(abar_t) and sqrt(1 - abar_t) at one step."""
        return self._scales[t]

    @cached_property
    def _scales(self) -> list[tuple[float, float]]:
        return list(zip(np.sqrt(self.alpha_bar).tolist(), np.sqrt(1.0 - self.alpha_bar).tolist(), strict=True))

    def add_noise(self, clean: Numbers, noise: Numbers, t: Tensor | int) -> Numbers:
        """Return noisy samples sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon (equation 2) at one step, or at (B,)."""
        signal, sigma = self.scale(t) if isinstance(t, int) else self.scales(t, clean)
        return signal * clean + sigma * noise

    def target(self, prediction: str, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Return what a network is trained to predict of noisy samples.

        ``noise`` is epsilon (equation 5), ``clean`` is z_0, and ``velocity`` is v = sqrt(abar_t) epsilon -
        sqrt(1 - abar_t) z_0 (Salimans and Ho 2022).
        """
        if prediction == "noise":
            return noise
        if prediction == "clean":
            return clean
        signal, sigma = self.scales(t, clean)
        return signal * noise - sigma * clean

    def estimate(self, prediction: str, sample: Numbers, output: Numbers, t: int) -> Estimate:
        """Return noise and clean sample from a network's output for a noisy sample; inverts :meth:`target`."""
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
