"""The noise schedule of Gaussian diffusion (equation 2 of the paper), and what a network predicts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from apex_ompl.errors import UnknownNameError
from apex_ompl.util.validation import check_integer

SCHEDULES = ("cosine", "linear")
PREDICTIONS = ("noise", "velocity", "clean")
MOST_NOISE = 0.999  # of a step of the cosine schedule, as its authors cap it


class Estimate(NamedTuple):
    """What a noisy sample is made of, as the network sees it.

    Attributes:
        noise: The noise in it, of the sample's shape.
        clean: The sample without it.
    """

    noise: Tensor
    clean: Tensor


@dataclass(frozen=True)
class NoiseSchedule:
    """How much of a sample is left at each of T steps of noising, t = 0 ... T - 1.

    ``linear`` is that of Ho et al. (2020), its variances scaled so that T steps reach what their 1000 reach; ``cosine``
    that of Nichol and Dhariwal (2021).

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
        if self.kind not in SCHEDULES:
            raise UnknownNameError("noise schedule", self.kind, SCHEDULES)

    @cached_property
    def betas(self) -> Tensor:
        """Variance of the noise that each step adds, shape (steps,), float64."""
        if self.kind == "linear":
            scale = 1000.0 / self.steps
            return torch.linspace(1e-4 * scale, 0.02 * scale, self.steps, dtype=torch.float64).clamp(max=MOST_NOISE)
        at = torch.arange(self.steps + 1, dtype=torch.float64) / self.steps
        left = torch.cos((at + 0.008) / 1.008 * math.pi / 2) ** 2
        return (1.0 - left[1:] / left[:-1]).clamp(max=MOST_NOISE)

    @cached_property
    def alpha_bar(self) -> Tensor:
        """Share of the sample's variance that is left at each step, shape (steps,), float64."""
        return torch.cumprod(1.0 - self.betas, dim=0)

    def scales(self, t: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return the factors of sample and noise at steps (B,), to be multiplied with tensors like ``like``."""
        left = self.alpha_bar[t.to(self.alpha_bar.device)]
        left = left.reshape(*left.shape, *[1] * (like.ndim - left.ndim))
        return left.sqrt().to(like), (1.0 - left).sqrt().to(like)

    def scale(self, t: int) -> tuple[float, float]:
        """Return the factors of sample and noise at one step."""
        return self._scales[t]

    @cached_property
    def _scales(self) -> list[tuple[float, float]]:
        return list(zip(self.alpha_bar.sqrt().tolist(), (1.0 - self.alpha_bar).sqrt().tolist(), strict=True))

    def noisy(self, clean: Tensor, noise: Tensor, t: Tensor | int) -> Tensor:
        """Return samples with noise in them (equation 2): one step for all, or shape (B,) for one each."""
        signal, sigma = self.scale(t) if isinstance(t, int) else self.scales(t, clean)
        return signal * clean + sigma * noise

    def target(self, prediction: str, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Return what a network learns to say of noisy samples: the noise (equation 5), the velocity or the sample.

        The velocity is that of Salimans and Ho (2022).
        """
        if prediction == "noise":
            return noise
        if prediction == "clean":
            return clean
        signal, sigma = self.scales(t, clean)
        return signal * noise - sigma * clean

    def estimate(self, prediction: str, sample: Tensor, said: Tensor, t: int) -> Estimate:
        """Return noise and clean sample from what a network says of a noisy one."""
        signal, sigma = self.scale(t)
        if prediction == "noise":
            return Estimate(said, (sample - sigma * said) / signal)
        if prediction == "clean":
            return Estimate((sample - signal * said) / sigma, said)
        return Estimate(sigma * sample + signal * said, signal * sample - sigma * said)

    def clipped(self, found: Estimate, sample: Tensor, t: int, most: float | None) -> Estimate:
        """Return an estimate whose clean sample is at most ``most``, and whose noise fits it where that changed it."""
        if most is None:
            return found
        signal, sigma = self.scale(t)
        clean = found.clean.clamp(-most, most)
        return Estimate(torch.where(clean == found.clean, found.noise, (sample - signal * clean) / sigma), clean)

    def times(self, count: int, first: int | None = None) -> list[int]:
        """Return ``count`` steps at which to denoise, evenly from ``first`` down ("trailing", Lin et al. 2024).

        Args:
            count: How many, at most first + 1.
            first: The noisiest; by default the last of the schedule.

        Raises:
            ParameterError: There are not as many, or no such step.
        """
        top = self.steps - 1 if first is None else first
        check_integer(top, "first step", 0, self.steps - 1)
        check_integer(count, "number of denoising steps", 1, top + 1)
        return [round((top + 1) * (1.0 - k / count)) - 1 for k in range(count)]
