"""Loss of a training phase as a module, as ``DistributedDataParallel`` wants it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from apex_ompl.training.autoencoder import VariationalLatent
from apex_ompl.training.conditions import Conditions
from apex_ompl.training.latent_diffusion import Collide, Draws, LatentDiffusion, Look


class Objective(nn.Module):
    """Loss of a phase: the negative ELBO of the autoencoder, or the mean square error of the denoiser."""

    def __init__(
        self, network: LatentDiffusion, divergence: float, look: Look | None = None, collide: Collide | None = None
    ) -> None:
        """Train a model.

        Args:
            network: The model.
            divergence: Weight of the autoencoder's Kullback-Leibler divergence.
            look: Returns what lies along paths, for a model that sees its own estimate.
            collide: Returns what the collisions of paths cost; None where they do not count.
        """
        super().__init__()
        self.network, self.divergence, self._look, self._collide = network, divergence, look, collide

    def forward(self, phase: str, control: Tensor, conditions: Conditions, draws: Draws) -> Tensor:
        """Return the loss of a batch of paths.

        Args:
            phase: ``autoencoder`` or ``denoiser``.
            control: Control points, shape (B, points, dof) [rad].
            conditions: Conditions of the paths.
            draws: Random numbers.
        """
        autoencoder = self.network.autoencoder
        if phase == "autoencoder":
            assert isinstance(autoencoder, VariationalLatent)
            return autoencoder.loss(control, draws.noise, self.divergence)[0]
        with torch.no_grad(), torch.autocast(control.device.type, enabled=False):
            clean = autoencoder.encode(control)
        return self.network.loss(clean, draws, conditions, self._look, self._collide)
