"""Obstacle guidance: denoising improved by the collision cost of the decoded path (section III-C of the paper)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from apex_ompl.diffusion.autoencoder import Autoencoder
from apex_ompl.diffusion.sampler import Predict
from apex_ompl.diffusion.schedule import Estimate, NoiseSchedule
from apex_ompl.errors import UnknownNameError
from apex_ompl.kernel import Kernel
from apex_ompl.types import Array
from apex_ompl.util.validation import check_integer, check_number, check_positive

SCALINGS = ("noise", "clean")


@dataclass(frozen=True)
class Guidance:
    """How strongly, and when.

    Attributes:
        gamma: Scale of the guidance; 0 gives the plain model, bit for bit.
        scaling: ``noise`` adds to the noise as in equation 7, in proportion to the noise that is left; ``clean`` adds
            the gradient to the clean sample, not scaled with the noise.
        clip: Longest gradient, in standard deviations of the latent space.
        begin: It acts at steps below this share of the schedule; 1 means all. Two deterministic steps over 256 are
            those at 255 and 127.
        margin: Clearance below which a state costs [m].
        samples: How many states of a path are looked at.
    """

    gamma: float = 1.0
    scaling: str = "clean"
    clip: float = 1.0
    begin: float = 0.6
    margin: float = 0.03
    samples: int = 64

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ParameterError: One is out of range.
            UnknownNameError: No such scaling.
        """
        if self.scaling not in SCALINGS:
            raise UnknownNameError("scaling of guidance", self.scaling, SCALINGS)
        for name, value in (("gamma", self.gamma), ("clip", self.clip), ("begin", self.begin)):
            check_number(value, name, 0.0)
        check_positive(self.margin, "margin")
        check_integer(self.samples, "samples", 2)


def collision_cost(kernel: Kernel, paths: Array, margin: float) -> tuple[Array, Array]:
    """Return what paths, shape (B, N, dof), cost, shape (B,), and its gradient, shape (B, N, dof) [1/rad].

    The cost is the sum over states, divided by their number, of half the squared shortfall of the least clearance
    from ``margin``, to the obstacles and of the robot to itself, in margins. It is minus log p(g given x) in equation 6
    of the paper.
    """
    count, states, dof = paths.shape
    lower, upper = kernel.robot.arrays.lower, kernel.robot.arrays.upper
    inside = np.clip(paths.reshape(-1, dof), lower, upper)
    clearance, slope = kernel.clearance_gradient(inside, margin)
    short = np.where(np.isfinite(clearance), np.maximum(margin - clearance, 0.0), 0.0) / margin
    cost = 0.5 * (short**2).sum(axis=1).reshape(count, states).mean(axis=1)
    rows = -(short[:, :, None] * np.nan_to_num(slope)).sum(axis=1) / margin
    return cost, rows.reshape(count, states, dof) / states


class _Cost(torch.autograd.Function):
    """The kernel's cost inside of torch."""

    @staticmethod
    def forward(context: Any, paths: Tensor, kernel: Kernel, margin: float) -> Tensor:
        cost, slope = collision_cost(kernel, paths.detach().cpu().double().numpy(), margin)
        context.save_for_backward(torch.from_numpy(slope).to(paths))
        return torch.from_numpy(cost).to(paths)

    @staticmethod
    def backward(context: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (slope,) = context.saved_tensors
        return grads[0][:, None, None] * slope, None, None


def log_likelihood(
    autoencoder: Autoencoder, kernel: Kernel, latent: Tensor, ends: tuple[Tensor, Tensor], guidance: Guidance
) -> Tensor:
    """Return log p(g given x) of latent vectors, shape (B,), but for a constant: minus the collision cost.

    Args:
        autoencoder: Decodes them.
        kernel: The robot among its obstacles.
        latent: Shape (B, *latent).
        ends: Starts and goals, each of shape (B, dof) [rad].
        guidance: Says what costs.
    """
    which = torch.linspace(0, autoencoder.spline.states - 1, guidance.samples).round().long()
    paths = autoencoder.decode(latent, *ends)[:, which]
    cost: Tensor = _Cost.apply(paths, kernel, guidance.margin)  # type: ignore[no-untyped-call]
    return -cost


def guided(
    predict: Predict, slope: Callable[[Tensor], Tensor], schedule: NoiseSchedule, guidance: Guidance,
    most: float | None = None,
) -> Predict:  # fmt: skip
    """Return a denoiser that is drawn to what is likely.

    With ``scaling="noise"`` this is equation 7 of the paper with alpha_bar under the root, as Dhariwal and Nichol
    (2021) have it: noise - gamma * sqrt(1 - alpha_bar) * grad log p. The gradient is taken at the estimate of the clean
    sample and goes through decoder and kernel, not through the denoiser, of whose derivative the factor
    1 / sqrt(alpha_bar) is kept.

    Args:
        predict: The plain denoiser.
        slope: Gives the gradient of log p(g given x) at clean samples, of their shape.
        schedule: The noise schedule.
        guidance: How strongly, and when.
        most: Clean samples are clipped at this, as those of the plain denoiser are.
    """
    if guidance.gamma == 0.0:
        return predict

    def improved(sample: Tensor, t: int) -> Estimate:
        found = predict(sample, t)
        if t >= guidance.begin * schedule.steps:
            return found
        signal, sigma = schedule.scale(t)
        way = slope(found.clean)
        if guidance.scaling == "noise":
            noise = found.noise - guidance.gamma * sigma * shortened(way / signal, guidance.clip)
            clean = (sample - sigma * noise) / signal
        else:
            clean = found.clean + guidance.gamma * shortened(way, guidance.clip)
            noise = (sample - signal * clean) / sigma
        return schedule.clipped(Estimate(noise, clean), sample, t, most)

    return improved


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the gradient of a function that gives one number for each row."""
    with torch.enable_grad():
        inside = at.detach().requires_grad_()
        found: Tensor = torch.autograd.grad(function(inside).sum(), inside)[0]
    return found


def shortened(slope: Tensor, most: float) -> Tensor:
    """Return gradients (B, ...) that are at most so long."""
    length = slope.flatten(1).norm(dim=1).clamp(min=1e-12)
    share: Tensor = (most / length).clamp(max=1.0)
    return slope * share.reshape(-1, *[1] * (slope.ndim - 1))
