"""What is minimised, and the processes that do it together."""

from __future__ import annotations

import os
from dataclasses import dataclass

import torch
from torch import Tensor, distributed, nn

from apex_ompl.diffusion.autoencoder import VariationalLatent
from apex_ompl.diffusion.conditions import Conditions
from apex_ompl.diffusion.model import LatentDiffusion


@dataclass(frozen=True)
class Place:
    """One of the processes that train together.

    Attributes:
        rank: Its number.
        world: How many there are.
        device: Where it computes.
    """

    rank: int
    world: int
    device: torch.device

    @classmethod
    def here(cls) -> Place:
        """Return this process, joined to the others that ``torchrun`` started if it did."""
        rank, world, local = (int(os.environ.get(k, d)) for k, d in (("RANK", 0), ("WORLD_SIZE", 1), ("LOCAL_RANK", 0)))
        cuda = torch.cuda.is_available()
        device = torch.device("cuda", local) if cuda else torch.device("cpu")
        if cuda:
            torch.cuda.set_device(device)
        if world > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if cuda else "gloo")
        return cls(rank, world, device)

    def leave(self) -> None:
        """Part from the others."""
        if self.world > 1 and distributed.is_initialized():
            distributed.destroy_process_group()


class Objective(nn.Module):
    """The loss of a phase as a module, which is what several processes share gradients of."""

    def __init__(self, network: LatentDiffusion, divergence: float) -> None:
        """Train ``network``."""
        super().__init__()
        self.network, self.divergence = network, divergence

    def forward(self, phase: str, control: Tensor, given: Conditions, noise: Tensor, t: Tensor) -> Tensor:
        """Return the loss of paths, control points (B, points, dof)."""
        autoencoder = self.network.autoencoder
        if phase == "autoencoder":
            assert isinstance(autoencoder, VariationalLatent)
            return autoencoder.loss(control, noise, self.divergence)[0]
        with torch.no_grad():
            clean = autoencoder.encode(control)
        return self.network.loss(clean, noise, t, given)
