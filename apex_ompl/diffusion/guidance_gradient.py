"""Gradient of the obstacle guidance through a decoder of torch."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from apex_ompl.diffusion.autoencoder import Autoencoder
from apex_ompl.diffusion.guidance import Guidance, collision_cost
from apex_ompl.kernel import Kernel


class _CollisionCost(torch.autograd.Function):
    """:func:`collision_cost` as a differentiable function of torch."""

    @staticmethod
    def forward(context: Any, paths: Tensor, kernel: Kernel, margin: float) -> Tensor:
        cost, slopes = collision_cost(kernel, paths.detach().cpu().double().numpy(), margin)
        context.save_for_backward(torch.from_numpy(slopes).to(paths))
        return torch.from_numpy(cost).to(paths)

    @staticmethod
    def backward(context: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (slopes,) = context.saved_tensors
        return grads[0][:, None, None] * slopes, None, None


def log_likelihood(
    autoencoder: Autoencoder, kernel: Kernel, latent: Tensor, ends: tuple[Tensor, Tensor], guidance: Guidance
) -> Tensor:
    """Return log p(g | z) of latent vectors up to a constant, shape (B,): minus the collision cost of their paths.

    Args:
        autoencoder: Decoder of the latent vectors.
        kernel: The robot among its obstacles.
        latent: Latent vectors z, shape (B, *latent).
        ends: Starts and goals, each of shape (B, dof) [rad].
        guidance: Margin of the cost, and number of states.
    """
    paths = autoencoder.decode(latent, *ends)[:, guidance.states(autoencoder.spline.states)]
    cost: Tensor = _CollisionCost.apply(paths, kernel, guidance.margin)  # type: ignore[no-untyped-call]
    return -cost


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the gradient, of the shape of ``at``, of a function from (B, ...) to one number a row, (B,)."""
    with torch.enable_grad():
        inside = at.detach().requires_grad_()
        found: Tensor = torch.autograd.grad(function(inside).sum(), inside)[0]
    return found
