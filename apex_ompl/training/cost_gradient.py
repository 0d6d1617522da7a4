"""Costs of paths that the kernel computes, in the graphs of torch: obstacle guidance through a decoder, and losses."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from apex_ompl.kernel import Kernel
from apex_ompl.model.guidance import Guidance, collision_cost
from apex_ompl.training.autoencoder import Autoencoder


def with_slopes(paths: Tensor, cost: Tensor, slopes: Tensor) -> Tensor:
    """Return costs of paths that were computed outside of torch as functions of the paths, with known gradients.

    Args:
        paths: Shape (B, N, dof) [rad].
        cost: Shape (B,).
        slopes: Gradients of the costs, shape (B, N, dof).
    """
    return cost + (slopes * (paths - paths.detach())).sum(dim=(1, 2))


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
    found = collision_cost(kernel, paths.detach().cpu().double().numpy(), guidance.margin)
    return -with_slopes(paths, *(torch.from_numpy(values).to(paths) for values in found))


def gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Return the gradient, of the shape of ``at``, of a function from (B, ...) to one number a row, (B,)."""
    with torch.enable_grad():
        inside = at.detach().requires_grad_()
        found: Tensor = torch.autograd.grad(function(inside).sum(), inside)[0]
    return found
