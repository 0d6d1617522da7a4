"""Loss of a training phase as a module, as ``DistributedDataParallel`` wants it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from apex_ompl.diffusion.autoencoder import VariationalLatent
from apex_ompl.diffusion.conditions import Conditions
from apex_ompl.diffusion.model import LatentDiffusion


class Objective(nn.Module):
    """Loss of a phase: the negative ELBO of the autoencoder, or the mean square error of the denoiser."""

    def __init__(self, network: LatentDiffusion, divergence: float) -> None:
        """Train ``network``; ``divergence`` is the weight of the autoencoder's Kullback-Leibler divergence."""
        super().__init__()
        self.network, self.divergence = network, divergence

    def forward(self, phase: str, control: Tensor, conditions: Conditions, noise: Tensor, t: Tensor) -> Tensor:
        """Return the loss of a batch of paths.

        Args:
            phase: ``autoencoder`` or ``denoiser``.
            control: Control points, shape (B, points, dof) [rad].
            conditions: Conditions of the paths.
            noise: Standard normal, shape (B, *latent).
            t: Diffusion steps, shape (B,).
        """
        autoencoder = self.network.autoencoder
        if phase == "autoencoder":
            assert isinstance(autoencoder, VariationalLatent)
            return autoencoder.loss(control, noise, self.divergence)[0]
        with torch.no_grad():
            clean = autoencoder.encode(control)
        return self.network.loss(clean, noise, t, conditions)
