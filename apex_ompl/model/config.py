"""Configuration of a latent diffusion model: all but its weights."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from apex_ompl.util.schema import StrictModel

Count = Annotated[int, Field(ge=1)]
Size = Annotated[int, Field(ge=1, le=16_384)]  # of layers and inputs; larger ones would exhaust the memory


WORKSPACE_CENTER = (0.4, 0.0, 0.6)
"""Origin of all points among the features of a model, by default [m]."""

OBSTACLE_SCENES = ("set", "distances")
"""Scenes of conditions that see obstacles one by one."""


class SplineConfig(StrictModel):
    """The spline of the control points, see ``apex_ompl.paths.spline.Spline``."""

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
    """Encoder of conditions, see ``apex_ompl.training.networks.ConditionEncoder``.

    Attributes:
        scene: ``none``, ``set``, ``distances`` or ``clearances``.
        point: Whether the obstacle point of the paper is an input.
        width: Width of the hidden layers.
        out: Size of the encoded condition.
        along: Number of states of the straight line at which the probe points are placed.
        keys: Number of key states of ``clearances``.
        hands: Links whose held objects ``clearances`` sees.
        center: Origin of the points among the features, in the middle of the robot's workspace [m].
        reach: Length by which positions relative to it are divided [m].
        refined: Whether the denoiser of ``clearances`` also sees the obstacles along its own last estimate of the path.
    """

    scene: Literal["none", "set", "distances", "clearances"] = "distances"
    point: bool = False
    width: Size = 256
    out: Size = 512
    along: Annotated[Size, Field(ge=2)] = 7
    keys: Size = 512
    hands: tuple[str, ...] = ()
    center: tuple[float, float, float] = WORKSPACE_CENTER
    reach: Annotated[float, Field(gt=0.0)] = 1.0
    refined: bool = False

    @model_validator(mode="after")
    def _sees_clearances(self) -> Self:
        if self.refined and self.scene != "clearances":
            raise ValueError("expected refined for the scene 'clearances' alone")
        return self


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
    """Diffusion process, see ``apex_ompl.model.diffusion.NoiseSchedule``.

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
    """Default sampling of the model, see ``apex_ompl.model.proposals.Sampling``."""

    sampler: Literal["ddpm", "ddim", "dpm_solver"] = "ddim"
    steps: Size = 2
    temperature: Annotated[float, Field(ge=0.0)] = 1.0


class ModelConfig(StrictModel):
    """Configuration of a model: all but its weights.

    Attributes:
        robot: Name of the robot.
        joints: Its planned joints in state order.
        probes: Number of probe points on the robot.
        arms: Numbers of arms and of their clusters of bodies with clearances at key states; 0 where none are.
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
    arms: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = (0, 0)
    spline: SplineConfig = SplineConfig()
    latent: LatentConfig = LatentConfig()
    condition: ConditionConfig = ConditionConfig()
    denoiser: DenoiserConfig = DenoiserConfig()
    noise: NoiseConfig = NoiseConfig()
    sampling: SamplingConfig = SamplingConfig()

    @model_validator(mode="after")
    def _arms_fit(self) -> Self:
        if (self.condition.scene == "clearances") != (min(self.arms) > 0):
            raise ValueError("expected arms where the scene is 'clearances', and none elsewhere")
        return self

    @property
    def scene_features(self) -> int:
        """Number of features of a scene ``clearances``, 0 of others."""
        condition = self.condition
        if condition.scene != "clearances":
            return 0
        return condition.keys * self.arms[0] + self.along_size + HELD_FEATURES * len(condition.hands)

    @property
    def along_size(self) -> int:
        """Number of features along a path, of a scene ``clearances``."""
        return self.condition.along * (7 * self.probes + len(self.joints))


PIECES = 4  # balls of a cluster of bodies that moves together, at key states
HELD_FEATURES = 7  # of a hand: whether it holds something, the center and the half edges of a box around it


def key_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the buffers of key states, by name; none where a model has no key states."""
    if config.condition.scene != "clearances":
        return {}
    arms, clusters = config.arms
    dof, keys = len(config.joints), config.condition.keys
    return {"key_state": (keys, dof), "key_joint": (arms, clusters), "key_ball": (arms, clusters, 1 + PIECES, 4)}
