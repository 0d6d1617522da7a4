"""The latent diffusion model: autoencoder, encoder of conditions, and denoiser, with their configurations."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from apex_ompl.diffusion.autoencoder import Autoencoder, LinearLatent, VariationalLatent
from apex_ompl.diffusion.conditions import Conditions
from apex_ompl.diffusion.denoisers import MLPDenoiser, UNetDenoiser
from apex_ompl.diffusion.encoders import ConditionEncoder
from apex_ompl.diffusion.sampler import Predict
from apex_ompl.diffusion.schedule import Estimate, NoiseSchedule
from apex_ompl.trajopt.spline import Spline
from apex_ompl.util.schema import StrictModel

Count = Annotated[int, Field(ge=1)]
Size = Annotated[int, Field(ge=1, le=16_384)]  # of layers and inputs; larger ones would exhaust the memory


class SplineConfig(StrictModel):
    """The spline of the control points, see ``apex_ompl.trajopt.spline.Spline``."""

    points: Size = 14
    pinned: Size = 1
    states: Size = 256
    degree: Size = 5


class LatentConfig(StrictModel):
    """The latent space.

    Attributes:
        kind: ``linear`` for whitened principal components of the free control points, ``variational`` for a network
            over all states.
        dim: Number of components of the linear latent space.
        channels: Channels of the variational latent space.
        width: Channels of its hidden layers.
        halvings: Number of its layers that halve the length.
    """

    kind: Literal["linear", "variational"] = "linear"
    dim: Size = 64
    channels: Size = 8
    width: Annotated[Size, Field(ge=8, multiple_of=8)] = 64
    halvings: Annotated[int, Field(ge=1, le=6)] = 4


class ConditionConfig(StrictModel):
    """Encoder of conditions, see ``apex_ompl.diffusion.encoders.ConditionEncoder``.

    Attributes:
        scene: ``none``, ``set`` or ``distances``.
        point: Whether the obstacle point of the paper is an input.
        width: Width of the hidden layers.
        out: Size of the encoded condition.
        along: Number of states of the straight line at which the probe points are placed.
    """

    scene: Literal["none", "set", "distances"] = "distances"
    point: bool = False
    width: Size = 256
    out: Size = 512
    along: Annotated[Size, Field(ge=2)] = 7


class DenoiserConfig(StrictModel):
    """Denoising network.

    Attributes:
        kind: ``mlp``, ``unet``, or ``regression``: the MLP, evaluated once to predict the latent vector itself.
        width: Width of the MLP, or channels of the U-Net's first resolution.
        blocks: Blocks of the MLP.
        multipliers: Channels of the U-Net's resolutions, in widths.
    """

    kind: Literal["mlp", "unet", "regression"] = "mlp"
    width: Annotated[Size, Field(ge=8, multiple_of=8)] = 768
    blocks: Size = 4
    multipliers: Annotated[tuple[Size, ...], Field(min_length=1, max_length=5)] = (1, 2, 4)


class NoiseConfig(StrictModel):
    """Diffusion process, see ``apex_ompl.diffusion.schedule.NoiseSchedule``.

    Attributes:
        steps: Number of steps T.
        schedule: ``cosine`` or ``linear``.
        prediction: Quantity that the network predicts: ``noise``, ``velocity`` or ``clean``.
        most: Number of standard deviations at which clean samples are clipped; not at all by default, as paths among
            many obstacles have large components.
    """

    steps: Size = 256
    schedule: Literal["cosine", "linear"] = "cosine"
    prediction: Literal["noise", "velocity", "clean"] = "velocity"
    most: Annotated[float, Field(gt=0)] | None = None


class SamplingConfig(StrictModel):
    """Default sampling of the model, see ``apex_ompl.diffusion.proposals.Sampling``."""

    sampler: Literal["ddpm", "ddim", "dpm_solver"] = "ddim"
    steps: Size = 2


class ModelConfig(StrictModel):
    """Configuration of a model: all but its weights.

    Attributes:
        robot: Name of the robot.
        joints: Its planned joints in state order.
        probes: Number of probe points on the robot.
        spline: Spline of the control points.
        latent: Latent space.
        condition: Encoder of conditions.
        denoiser: Denoising network.
        noise: Diffusion process.
        sampling: Default sampling.
    """

    robot: str
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    probes: Size
    spline: SplineConfig = SplineConfig()
    latent: LatentConfig = LatentConfig()
    condition: ConditionConfig = ConditionConfig()
    denoiser: DenoiserConfig = DenoiserConfig()
    noise: NoiseConfig = NoiseConfig()
    sampling: SamplingConfig = SamplingConfig()


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
            probes=config.probes, along=condition.along,
        )  # fmt: skip
        shape, net = self.autoencoder.latent, config.denoiser
        if net.kind == "unet":
            channels = shape[0] if len(shape) > 1 else 1
            self.denoiser: nn.Module = UNetDenoiser(channels, condition.out, net.width, net.multipliers)
        else:
            self.denoiser = MLPDenoiser(math.prod(shape), condition.out, net.width, net.blocks)
        self.schedule = NoiseSchedule(config.noise.steps, config.noise.schedule)
        self.register_buffer("probe_joint", torch.zeros(config.probes, dtype=torch.int64))
        self.register_buffer("probe_offset", torch.zeros(config.probes, 3))

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

    def loss(self, clean: Tensor, noise: Tensor, t: Tensor, conditions: Conditions) -> Tensor:
        """Return the mean square error of the denoiser (equation 5 of the paper).

        loss = mean((f(sqrt(abar_t) z_0 + sqrt(1 - abar_t) epsilon, t, g) - target)^2), where the target is epsilon,
        the velocity or z_0, see :meth:`NoiseSchedule.target`.

        Args:
            clean: Latent vectors z_0 of data, shape (B, *latent).
            noise: Standard normal epsilon, of the same shape.
            t: Steps, shape (B,).
            conditions: Conditions g.
        """
        encoded = self.encoder(conditions)
        if self.is_regression:
            return nn.functional.mse_loss(self.denoise(torch.zeros_like(clean), torch.zeros_like(t), encoded), clean)
        output = self.denoise(self.schedule.add_noise(clean, noise, t), t, encoded)
        target = self.schedule.target(self.config.noise.prediction, clean, noise, t)
        return nn.functional.mse_loss(output.float(), target)

    def predict(self, encoded: Tensor) -> Predict:
        """Return the denoiser as samplers call it, for one encoded condition, (1, out), or one each, (B, out)."""
        noise = self.config.noise

        def predict(sample: Tensor, t: int) -> Estimate:
            steps = torch.full((1,), t, device=sample.device)
            estimate = self.schedule.estimate(noise.prediction, sample, self.denoise(sample, steps, encoded), t)
            return self.schedule.clipped(estimate, sample, t, noise.most)

        return predict
