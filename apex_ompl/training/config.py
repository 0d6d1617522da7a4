"""Configuration of a training run, a YAML file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import Field, model_validator

from apex_ompl.model.config import (
    ConditionConfig,
    Count,
    DenoiserConfig,
    LatentConfig,
    NoiseConfig,
    SamplingConfig,
)
from apex_ompl.util.schema import StrictModel, check_version, read_yaml, replaced, validate

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]


class MirrorConfig(StrictModel):
    """Mirror symmetry of a robot, see ``apex_ompl.training.data.Mirror``; one number for each joint."""

    order: tuple[Annotated[int, Field(ge=0)], ...]
    sign: tuple[Literal[-1, 1], ...]
    shift: tuple[float, ...]

    @model_validator(mode="after")
    def _fits(self) -> MirrorConfig:
        count = len(self.order)
        if not len(self.sign) == len(self.shift) == count or sorted(self.order) != list(range(count)):
            raise ValueError("expected every joint's number once in order, and as many signs and shifts")
        return self


class TrainingFile(StrictModel):
    """Configuration of a training as a YAML file, whose ``schema`` a subclass names by a field ``schema_``.

    Attributes:
        data: Folder of a data set, or a file of paths; or several.
        robot: File of the robot's kernel tables.
        decay: Weight decay.
        clip: Largest norm of the gradient.
        ema: Decay of the exponential moving average of the weights.
        precision: ``float32`` or ``bfloat16`` (mixed).
        seed: Seed of all random choices.
        weights: Relative frequency of paths in training, by patterns of ``suite/level``; the first that matches
            counts, 1 where none does.
        mirror: Mirror symmetry of the robot, by which the data are augmented.
        held_out: Share of the problems kept for the validation loss.
        log_every: Steps between two lines of the log.
        save_every: Seconds between two saves.
    """

    data: str | Annotated[tuple[str, ...], Field(min_length=1)]
    robot: str
    decay: Annotated[float, Field(ge=0.0)] = 1e-2
    clip: Positive = 1.0
    ema: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.999
    precision: Literal["float32", "bfloat16"] = "float32"
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    weights: dict[str, Annotated[float, Field(ge=0.0)]] = {}
    mirror: MirrorConfig | None = None
    held_out: Share = 0.02
    log_every: Count = 100
    save_every: Positive = 120.0

    @property
    def sources(self) -> tuple[str, ...]:
        """Data sets as a tuple."""
        return (self.data,) if isinstance(self.data, str) else self.data

    @classmethod
    def read(cls, path: str | os.PathLike[str], changes: Mapping[str, Any] | None = None) -> Self:
        """Read a configuration, with some keys replaced: ``changes`` maps dotted keys to values.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It does not follow the schema.
        """
        data = read_yaml(Path(path), "training configuration")
        (schema,) = get_args(cls.model_fields["schema_"].annotation)
        check_version(data, schema, path)
        return validate(cls, replaced(data, changes or {}, str(path)), str(path))


class AutoencoderTraining(StrictModel):
    """Training of a variational latent space, which comes before that of the denoiser.

    Attributes:
        steps: Number of steps.
        rate: Largest learning rate; its schedule is that of the denoiser.
        divergence: Weight of the Kullback-Leibler divergence in the loss.
    """

    steps: Count = 5000
    rate: Positive = 1e-3
    divergence: Annotated[float, Field(ge=0.0)] = 1e-5


class TrainingConfig(TrainingFile):
    """Configuration of ``scripts/train.py``; attributes are keys of the file, except ``validation_sampling``.

    Those of every training are described in :class:`TrainingFile`.

    Attributes:
        schema_: Version of the format.
        cases: Folder of validation problems, as ``generate_data.py --write-cases`` writes them; none by default.
        initial: Checkpoint whose weights the training starts with, by name or folder; its latent space and key states
            are kept. Random weights by default.
        latent: Latent space.
        condition: Encoder of conditions.
        denoiser: Denoising network.
        noise: Diffusion process.
        autoencoder: Training of a variational latent space.
        steps: Number of steps.
        batch: Paths in a step, over all processes.
        rate: Largest learning rate; it rises linearly over ``warmup`` steps and falls to 0 by half a cosine.
        warmup: Number of steps of the rise.
        parts: Share of the paths of which a part is taken, for a scene ``clearances``, as ``mixed`` is, see
            :class:`apex_ompl.training.conditions.Augmentation`.
        mixed: Share of the paths among whose obstacles are put some of another scene that leave it free.
        collision: Weight of the collision cost of the denoiser's estimates in the loss, for a scene ``clearances``, see
            :meth:`~apex_ompl.training.scene_encoding.TorchSceneEncoding.collision_cost`; not in validation losses.
        units: Number of units of a data set in memory at the same time; all by default.
        validate_every: Steps between two validations by proposals.
        proposals: Number of proposals for each problem of a validation.
        validation_sampling: Sampling of a validation; its key in the file is ``judged``.
        sampling: Default sampling of the trained model.
    """

    schema_: Literal["apex-ompl/training/1"] = Field(alias="schema")
    cases: str | None = None
    initial: str | None = None
    latent: LatentConfig = LatentConfig()
    condition: ConditionConfig = ConditionConfig()
    denoiser: DenoiserConfig = DenoiserConfig()
    noise: NoiseConfig = NoiseConfig()
    autoencoder: AutoencoderTraining = AutoencoderTraining()
    steps: Count = 20_000
    batch: Count = 512
    rate: Positive = 5e-4
    warmup: Count = 500
    parts: Share = 0.0
    mixed: Share = 0.0
    collision: Annotated[float, Field(ge=0.0)] = 0.0
    units: Count = 1_000_000
    validate_every: Count = 2000
    proposals: Count = 8
    validation_sampling: SamplingConfig = Field(SamplingConfig(), alias="judged")
    sampling: SamplingConfig = SamplingConfig()

    @model_validator(mode="after")
    def _varies_what_can_be_varied(self) -> Self:
        varied = self.parts or self.mixed or self.collision
        if varied and (self.condition.scene != "clearances" or self.condition.point):
            raise ValueError(
                "expected parts, mixed and collision for the scene 'clearances' without an obstacle point alone"
            )
        return self

    @model_validator(mode="after")
    def _begins_with_a_latent_space(self) -> Self:
        if self.initial is not None and self.latent.kind != "linear":
            raise ValueError("expected a linear latent space with initial: a variational one is trained anew")
        return self

    @property
    def determining(self) -> str:
        """Settings that determine the trained weights, as JSON: all but paths, logging, saving and validation."""
        return self.model_dump_json(
            exclude={
                "data", "robot", "cases", "log_every", "save_every", "validate_every", "proposals",
                "validation_sampling", "sampling",
            }
        )  # fmt: skip
