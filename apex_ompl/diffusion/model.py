"""The latent diffusion model: an autoencoder, an encoder of conditions, and a denoiser between them."""

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


class SplineConfig(StrictModel):
    """The spline of the control points, see ``apex_ompl.trajopt.spline.Spline``."""

    points: Count = 14
    pinned: Count = 1
    states: Count = 256
    degree: Count = 5


class LatentConfig(StrictModel):
    """The latent space.

    Attributes:
        kind: ``linear`` for whitened principal components of the free control points, ``variational`` for a network
            over all states.
        dim: Number of components.
        channels: Channels of the variational latent.
        width: Channels inside its networks.
        halvings: How often the length is halved.
    """

    kind: Literal["linear", "variational"] = "linear"
    dim: Count = 64
    channels: Count = 8
    width: Annotated[int, Field(ge=8, multiple_of=8)] = 64
    halvings: Annotated[int, Field(ge=1, le=6)] = 4


class ConditionConfig(StrictModel):
    """What the model sees, see ``apex_ompl.diffusion.encoders.ConditionEncoder``.

    Attributes:
        scene: ``none``, ``set`` or ``distances``.
        point: Whether it sees the obstacle point of the paper.
        width: Width inside the encoder.
        out: Size of what comes out of it.
        along: Number of states of the straight line at which probes are looked at.
    """

    scene: Literal["none", "set", "distances"] = "distances"
    point: bool = False
    width: Count = 256
    out: Count = 512
    along: Annotated[int, Field(ge=2)] = 7


class DenoiserConfig(StrictModel):
    """The network.

    Attributes:
        kind: ``mlp``, ``unet``, or ``regression``: the MLP, which is asked once for the latent vector itself.
        width: Width of the MLP, or channels of the U-Net's first resolution.
        blocks: Blocks of the MLP.
        multipliers: Channels of the U-Net's resolutions, in widths.
    """

    kind: Literal["mlp", "unet", "regression"] = "mlp"
    width: Annotated[int, Field(ge=8, multiple_of=8)] = 768
    blocks: Count = 4
    multipliers: Annotated[tuple[Count, ...], Field(min_length=1, max_length=5)] = (1, 2, 4)


class NoiseConfig(StrictModel):
    """The diffusion, see ``apex_ompl.diffusion.schedule.NoiseSchedule``.

    Attributes:
        steps: Number of steps T.
        schedule: ``cosine`` or ``linear``.
        prediction: What the network says: ``noise``, ``velocity`` or ``clean``.
        most: Clean samples are clipped at this many standard deviations; not at all by default, as paths among many
            obstacles have components far out.
    """

    steps: Count = 256
    schedule: Literal["cosine", "linear"] = "cosine"
    prediction: Literal["noise", "velocity", "clean"] = "velocity"
    most: Annotated[float, Field(gt=0)] | None = None


class SamplingConfig(StrictModel):
    """How paths are denoised unless something else is said, see ``apex_ompl.diffusion.proposals.Sampling``."""

    sampler: Literal["ddpm", "ddim", "dpm_solver"] = "ddim"
    steps: Count = 2


class ModelConfig(StrictModel):
    """All that makes a model, its weights left out.

    Attributes:
        robot: Name of the robot.
        joints: Its planned joints in state order.
        probes: Number of points of the robot that the model looks at.
        spline: Spline of the control points.
        latent: Latent space.
        condition: Encoder of conditions.
        denoiser: Network.
        noise: Diffusion.
        sampling: How paths are denoised unless something else is said.
    """

    robot: str
    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    probes: Count
    spline: SplineConfig = SplineConfig()
    latent: LatentConfig = LatentConfig()
    condition: ConditionConfig = ConditionConfig()
    denoiser: DenoiserConfig = DenoiserConfig()
    noise: NoiseConfig = NoiseConfig()
    sampling: SamplingConfig = SamplingConfig()


class LatentDiffusion(nn.Module):
    """Paths by diffusion in a latent space (section III-B of the paper; Rombach et al. 2022).

    Attributes:
        config: What it was made of.
        autoencoder: Between control points and latent vectors.
        encoder: Of conditions.
        denoiser: The network.
        schedule: The noise schedule.
        probe_joint: Joints of the points of the robot that the model looks at, shape (P,).
        probe_offset: Their places in the joints' frames, shape (P, 3) [m].
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
    def regresses(self) -> bool:
        """Whether the network gives latent vectors at once, and no diffusion is run."""
        return self.config.denoiser.kind == "regression"

    def said(self, latent: Tensor, t: Tensor, encoded: Tensor) -> Tensor:
        """Return what the network says of noisy latent vectors (B, *latent) at steps (B,) or, all alike, (1,)."""
        if isinstance(self.denoiser, MLPDenoiser):
            out: Tensor = self.denoiser(latent.flatten(1), t, encoded)
            return out.reshape(latent.shape)
        if latent.ndim == 2:
            out = self.denoiser(latent[:, None], t, encoded)[:, 0]
            return out
        out = self.denoiser(latent, t, encoded)
        return out

    def loss(self, clean: Tensor, noise: Tensor, t: Tensor, given: Conditions) -> Tensor:
        """Return the mean square error of what the network says (equation 5 of the paper).

        Args:
            clean: Latent vectors of data, shape (B, *latent).
            noise: Standard normal, of the same shape.
            t: Steps, shape (B,).
            given: Conditions.
        """
        encoded = self.encoder(given)
        if self.regresses:
            return nn.functional.mse_loss(self.said(torch.zeros_like(clean), torch.zeros_like(t), encoded), clean)
        said = self.said(self.schedule.noisy(clean, noise, t), t, encoded)
        wanted = self.schedule.target(self.config.noise.prediction, clean, noise, t)
        return nn.functional.mse_loss(said.float(), wanted)

    def predict(self, encoded: Tensor) -> Predict:
        """Return the function that samplers ask, for one encoded condition of shape (1, out), or (B, out)."""
        noise = self.config.noise

        def predict(sample: Tensor, t: int) -> Estimate:
            steps = torch.full((1,), t, device=sample.device)
            found = self.schedule.estimate(noise.prediction, sample, self.said(sample, steps, encoded), t)
            return self.schedule.clipped(found, sample, t, noise.most)

        return predict
