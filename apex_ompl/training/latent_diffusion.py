"""The latent diffusion model in torch: autoencoder, encoder of conditions, and denoiser."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from apex_ompl.model.config import ModelConfig, key_shapes
from apex_ompl.model.diffusion import NoiseSchedule
from apex_ompl.paths.spline import Spline
from apex_ompl.training.autoencoder import Autoencoder, LinearLatent, VariationalLatent
from apex_ompl.training.conditions import Conditions
from apex_ompl.training.networks import ConditionEncoder, MLPDenoiser, UNetDenoiser

COST_STATES = 8  # states of a path at which its collision cost is computed
FeaturesAlong = Callable[[Tensor, Conditions], Tensor]
"""Returns features, shape (B, F), along paths of control points, shape (B, points, dof) [rad]."""

CollisionCost = Callable[[Tensor, Conditions, Tensor], Tensor]
"""Returns the collision cost of paths of control points, shape (B, points, dof) [rad], at some places along them."""


class Draws(NamedTuple):
    """Random numbers of a batch's loss.

    Attributes:
        noise: Standard normal epsilon, shape (B, *latent).
        t: Diffusion steps, shape (B,).
        places: Where in each of L equal pieces of a path its collision cost is computed, shape (L,) in 0..1.
    """

    noise: Tensor
    t: Tensor
    places: Tensor


@dataclass(frozen=True)
class TrainingSchedule(NoiseSchedule):
    """Noise schedule for batches in which each sample has a step of its own."""

    _known: dict[torch.device, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

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

    def noisy(self, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Return noisy samples sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon (equation 2) at steps (B,)."""
        signal, sigma = self.scales(t, clean)
        return signal * clean + sigma * noise

    def target(self, prediction: str, clean: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Return the quantity that a network learns to predict from noisy samples; :meth:`estimate` is its inverse.

        ``noise`` is epsilon (equation 5), ``clean`` is z_0, and ``velocity`` is v = sqrt(abar_t) epsilon -
        sqrt(1 - abar_t) z_0 (Salimans and Ho 2022).
        """
        if prediction == "noise":
            return noise
        if prediction == "clean":
            return clean
        signal, sigma = self.scales(t, clean)
        return signal * noise - sigma * clean


class LatentDiffusion(nn.Module):
    """Latent diffusion model of paths (section III-B of the paper; Rombach et al. 2022).

    Names of modules and buffers are keys of the checkpoints' weights.

    Attributes:
        config: Configuration.
        autoencoder: Latent space of control points.
        encoder: Encoder of conditions.
        denoiser: Denoising network.
        schedule: Noise schedule.
        probe_joint: Joints that carry the probe points, shape (P,).
        probe_offset: Positions of the probe points in the joints' frames, shape (P, 3) [m].

    Models of scene ``clearances`` have the arrays of :class:`~apex_ompl.model.scene_encoding.KeyStates`, too:
    ``key_state``, ``key_joint`` and ``key_ball``.
    """

    probe_joint: Tensor
    probe_offset: Tensor

    def __init__(self, config: ModelConfig) -> None:
        """Make a model with random weights."""
        super().__init__()
        self.config = config
        dof, latent, condition = len(config.joints), config.latent, config.condition
        spline = Spline(**config.spline.model_dump())
        self.autoencoder: Autoencoder
        if latent.kind == "linear":
            self.autoencoder = LinearLatent(spline, dof, latent.dim)
        else:
            self.autoencoder = VariationalLatent(spline, dof, latent.channels, latent.width, latent.halvings)
        self.encoder = ConditionEncoder(
            dof, out=condition.out, width=condition.width, scene=condition.scene, point=condition.point,
            probes=config.probes, along=condition.along, scene_features=config.scene_features,
            refined=config.along_size if condition.refined else 0, center=condition.center, reach=condition.reach,
        )  # fmt: skip
        latent_shape, net = self.autoencoder.latent, config.denoiser
        if net.kind == "unet":
            channels = latent_shape[0] if len(latent_shape) > 1 else 1
            self.denoiser: nn.Module = UNetDenoiser(channels, condition.out, net.width, net.multipliers)
        else:
            self.denoiser = MLPDenoiser(math.prod(latent_shape), condition.out, net.width, net.blocks)
        self.schedule = TrainingSchedule(config.noise.steps, config.noise.schedule)
        self.register_buffer("probe_joint", torch.zeros(config.probes, dtype=torch.int64))
        self.register_buffer("probe_offset", torch.zeros(config.probes, 3))
        for name, shape in key_shapes(config).items():
            kind = torch.int64 if name == "key_joint" else torch.float32
            self.register_buffer(name, torch.zeros(shape, dtype=kind))

    @property
    def latent(self) -> tuple[int, ...]:
        """Shape of a latent vector."""
        return self.autoencoder.latent

    @property
    def is_regression(self) -> bool:
        """Whether the network predicts latent vectors directly, without diffusion."""
        return self.config.denoiser.kind == "regression"

    def denoise(self, latent: Tensor, t: Tensor, encoded: Tensor) -> Tensor:
        """Return the denoiser's output for noisy latent vectors (B, *latent), of their shape.

        Args:
            latent: Noisy latent vectors.
            t: Steps, shape (B,), or (1,) for one step for all.
            encoded: Encoded conditions, shape (B, out), or (1, out) for one condition for all.
        """
        if isinstance(self.denoiser, MLPDenoiser):
            out: Tensor = self.denoiser(latent.flatten(1), t, encoded)
            return out.reshape(latent.shape)
        if latent.ndim == 2:
            out = self.denoiser(latent[:, None], t, encoded)[:, 0]
            return out
        out = self.denoiser(latent, t, encoded)
        return out

    def draws(self, count: int, generator: torch.Generator) -> Draws:
        """Return the random numbers of the loss of ``count`` paths, on the CPU."""
        noise = torch.randn(count, *self.latent, generator=generator)
        t = torch.randint(self.config.noise.steps, (count,), generator=generator)
        return Draws(noise, t, torch.rand(COST_STATES, generator=generator))

    def loss(
        self, clean: Tensor, draws: Draws, conditions: Conditions, features_along: FeaturesAlong | None = None,
        collision_cost: CollisionCost | None = None,
    ) -> Tensor:  # fmt: skip
        """Return the mean square error of the denoiser (equation 5 of the paper).

        loss = mean((f(sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon, t, g) - target)^2), where the target is epsilon,
        the velocity or z_0, see :meth:`TrainingSchedule.target`. A denoiser that sees its own last estimate is
        evaluated at a noisier step first, without one; the loss is the mean of both. The collision cost of the
        denoiser's last estimate of z_0 may be added, after PRESTO (arXiv 2409.16012).

        Args:
            clean: Latent vectors z_0 of data, shape (B, *latent).
            draws: Noise epsilon and steps t.
            conditions: Conditions g.
            features_along: Where the denoiser sees its own estimate, returns the features along paths.
            collision_cost: Returns the collision cost of paths.
        """
        noise, t, places = draws
        encoded = self.encoder(conditions)
        if self.is_regression:
            return nn.functional.mse_loss(self.denoise(torch.zeros_like(clean), torch.zeros_like(t), encoded), clean)
        first, single = None, torch.autocast(clean.device.type, enabled=False)  # for paths, half precision is coarse
        if self.config.condition.refined:
            assert features_along is not None
            first, estimate = self._error(clean, noise, torch.maximum(t, t.roll(1)), encoded)
            with torch.no_grad(), single:
                along = features_along(self._decoded(estimate, conditions), conditions)
            encoded = self.encoder.refine(encoded, along)
        error, estimate = self._error(clean, noise, t, encoded)
        error = error if first is None else 0.5 * (first + error)
        if collision_cost is None:
            return error
        with single:
            return error + collision_cost(self._decoded(estimate, conditions), conditions, places)

    def _decoded(self, latent: Tensor, conditions: Conditions) -> Tensor:
        """Return the control points of latent vectors, inside the limits."""
        control = self.autoencoder.control(latent, conditions.start, conditions.goal)
        return torch.maximum(torch.minimum(control, self.encoder.upper), self.encoder.lower)

    def _error(self, clean: Tensor, noise: Tensor, t: Tensor, encoded: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean square error of the denoiser at steps t, and its estimate of the latent vectors."""
        prediction = self.config.noise.prediction
        sample = self.schedule.noisy(clean, noise, t)
        output = self.denoise(sample, t, encoded).float()
        error = nn.functional.mse_loss(output, self.schedule.target(prediction, clean, noise, t))
        signal, sigma = self.schedule.scales(t, clean)
        if prediction == "clean":
            return error, output
        found = (sample - sigma * output) / signal if prediction == "noise" else signal * sample - sigma * output
        return error, found
