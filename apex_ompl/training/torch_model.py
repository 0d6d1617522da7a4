"""A trained model evaluated by torch: any architecture, on any device."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.errors import ParameterError
from apex_ompl.kernel import Kernel
from apex_ompl.model.checkpoint import CheckpointConfig, check_shapes, read_checkpoint
from apex_ompl.model.config import key_shapes
from apex_ompl.model.guidance import Guidance
from apex_ompl.model.proposals import TrajectoryModel
from apex_ompl.model.quantization import expanded
from apex_ompl.model.query import Probes, Query
from apex_ompl.training.conditions import batch_queries
from apex_ompl.training.cost_gradient import gradient, log_likelihood
from apex_ompl.training.latent_diffusion import LatentDiffusion
from apex_ompl.types import Array
from apex_ompl.util.process import one_torch_thread


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


def load_torch_model(
    name: str | os.PathLike[str] = "apex", *, device: str | torch.device = "cpu", robot: str | None = None
) -> TorchModel:
    """Return a trained model that torch evaluates, whose networks are modules.

    Arguments are those of :func:`~apex_ompl.model.load_model`.

    Raises:
        ApexError: As :func:`~apex_ompl.model.load_model` does.
    """
    return torch_model(*read_checkpoint(name, robot), device)


def torch_model(
    config: CheckpointConfig, weights: Mapping[str, NDArray[Any]], source: Path, device: str | torch.device
) -> TorchModel:
    """Return a trained model from what :func:`~apex_ompl.model.checkpoint.read_checkpoint` returns.

    Raises:
        FileFormatError: The weights do not fit the configuration.
        ParameterError: There is no such device.
    """

    def shapes() -> dict[str, tuple[int, ...]]:
        with torch.device("meta"):  # without memory for them
            return {key: tuple(value.shape) for key, value in LatentDiffusion(config.model).state_dict().items()}

    check_shapes(weights, shapes, source)
    with torch.random.fork_rng(devices=[]):
        network = LatentDiffusion(config.model)
    state, values = network.state_dict(), expanded(weights)
    network.load_state_dict({key: torch.from_numpy(values[key]).to(one.dtype) for key, one in state.items()})
    try:
        network.to(device)
    except (RuntimeError, AssertionError) as error:
        raise ParameterError("device", str(device), "a device of torch's that is there") from error
    return TorchModel(network, config.trained)
