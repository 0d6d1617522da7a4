"""A trained model evaluated by torch: any architecture, on any device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.diffusion.conditions import batch_queries
from apex_ompl.diffusion.cost_gradient import gradient, log_likelihood
from apex_ompl.diffusion.guidance import Guidance
from apex_ompl.diffusion.model import LatentDiffusion
from apex_ompl.diffusion.model_config import key_shapes
from apex_ompl.diffusion.proposals import TrajectoryModel
from apex_ompl.diffusion.query import Probes, Query
from apex_ompl.kernel import Kernel
from apex_ompl.types import Array
from apex_ompl.util.threads import one_torch_thread


class TorchModel(TrajectoryModel):
    """Trained model whose networks torch evaluates.

    Attributes:
        network: The networks.
    """

    def __init__(self, network: LatentDiffusion, about: Mapping[str, Any]) -> None:
        """Use a network with its present weights; they are frozen."""
        joint, offset = network.probe_joint.cpu().numpy(), network.probe_offset.cpu().double().numpy()
        keys = {name: getattr(network, name).cpu().numpy() for name in key_shapes(network.config)}
        super().__init__(network.config, about, Probes(joint, offset, network.config.condition.along), keys)
        self.network = network.eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        """Where it runs."""
        return self.network.probe_offset.device

    def one_thread(self) -> AbstractContextManager[None]:
        """Let torch compute by one thread inside a block."""
        return one_torch_thread()

    def zeros(self, count: int) -> Tensor:
        """Return ``count`` latent vectors of zeros."""
        return torch.zeros(count, *self.network.latent, device=self.device)

    @torch.no_grad()
    def encode(self, control: Array) -> Tensor:
        """Return the latent vectors of control points, shape (B, points, dof) [rad]."""
        return self.network.autoencoder.encode(self._tensor(control))

    @torch.no_grad()
    def condition(self, queries: Sequence[Query], kernel: Kernel) -> Tensor:
        """Return the encoded conditions of Q queries, shape (Q, out)."""
        found: Tensor = self.network.encoder(batch_queries(queries, self.sight or self.probes, kernel).to(self.device))
        return found

    @torch.no_grad()
    def refine(self, condition: Tensor, along: NDArray[np.float32]) -> Tensor:
        """Return encoded conditions with what lies along estimates of paths, features of shape (B, F)."""
        return self.network.encoder.refine(condition, self._tensor(along))

    @torch.no_grad()
    def denoise(self, latent: Tensor, t: int, condition: Tensor) -> Tensor:
        """Return the denoiser's output for latent vectors at a step, each with its condition, or one for all."""
        return self.network.denoise(latent, torch.full((1,), t, device=latent.device), condition)

    def score(self, latent: Tensor, kernel: Kernel, ends: tuple[Array, Array], guidance: Guidance) -> Tensor:
        """Return the gradient of log p(g | z) at latent vectors z, see :meth:`TrajectoryModel.score`."""
        start, goal = map(self._tensor, ends)

        def log_p(clean: Tensor) -> Tensor:
            return log_likelihood(self.network.autoencoder, kernel, clean, (start, goal), guidance)

        return gradient(log_p, latent)

    @torch.no_grad()
    def control(self, latent: Tensor, ends: tuple[Array, Array]) -> Array:
        """Return control points, shape (B, points, dof) [rad], of latent vectors between starts and goals."""
        return self.network.autoencoder.control(latent, *map(self._tensor, ends)).cpu().double().numpy()

    def _tensor(self, values: NDArray[Any]) -> Tensor:
        return torch.tensor(np.asarray(values), dtype=torch.float32, device=self.device)
