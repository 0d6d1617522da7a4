"""What a training run is made of, as a YAML file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from apex_ompl.diffusion.model import ConditionConfig, Count, DenoiserConfig, LatentConfig, NoiseConfig, SamplingConfig
from apex_ompl.errors import FileFormatError
from apex_ompl.util.schema import StrictModel, read_yaml, validate

SCHEMA = "apex-ompl/training/1"
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]


class MirrorConfig(StrictModel):
    """A symmetry of the robot, see ``apex_ompl.diffusion.data.Mirror``; one number for each joint."""

    order: tuple[Annotated[int, Field(ge=0)], ...]
    sign: tuple[Literal[-1, 1], ...]
    shift: tuple[float, ...]

    @model_validator(mode="after")
    def _fits(self) -> MirrorConfig:
        count = len(self.order)
        if not len(self.sign) == len(self.shift) == count or sorted(self.order) != list(range(count)):
            raise ValueError("expected every joint's number once in order, and as many signs and shifts")
        return self


class AutoencoderTraining(StrictModel):
    """How a variational latent space is trained, before the denoiser.

    Attributes:
        steps: Number of steps.
        rate: Learning rate at first; it falls to nothing.
        divergence: Weight of the divergence from the normal distribution.
    """

    steps: Count = 5000
    rate: Positive = 1e-3
    divergence: Annotated[float, Field(ge=0.0)] = 1e-5


class TrainingConfig(StrictModel):
    """What ``scripts/train.py`` reads.

    Attributes:
        schema_: Version of the format.
        data: Folder of a data set, or a file of paths; or several.
        robot: File of the robot's kernel tables.
        cases: Folder of validation problems, as ``generate_data.py --write-cases`` writes them; none by default.
        latent: Latent space.
        condition: Encoder of conditions.
        denoiser: Network.
        noise: Diffusion.
        autoencoder: How a variational latent space is trained.
        steps: Number of steps.
        batch: Paths in a step, over all processes.
        rate: Largest learning rate; it rises over ``warmup`` steps and falls to nothing by half a cosine.
        warmup: See ``rate``.
        decay: Weight decay.
        clip: Longest gradient.
        ema: Share of the averaged weights that a step keeps.
        precision: ``float32`` or ``bfloat16`` (mixed).
        seed: Of all random choices.
        weights: How often paths are drawn, by patterns of ``suite/level``; the first that fits counts, 1 by default.
        mirror: Symmetry of the robot that doubles the data.
        held_out: Share of the problems that only the validation loss sees.
        units: Units of a data set in memory at once; all by default.
        log_every: Steps between two lines of the log.
        save_every: Seconds between two saves.
        validate_every: Steps between two validations by proposals.
        proposals: Proposals for each problem of a validation.
        judged: How they are denoised.
        sampling: How the trained model denoises unless something else is said.
    """

    schema_: Literal["apex-ompl/training/1"] = Field(alias="schema")
    data: str | Annotated[tuple[str, ...], Field(min_length=1)]
    robot: str
    cases: str | None = None
    latent: LatentConfig = LatentConfig()
    condition: ConditionConfig = ConditionConfig()
    denoiser: DenoiserConfig = DenoiserConfig()
    noise: NoiseConfig = NoiseConfig()
    autoencoder: AutoencoderTraining = AutoencoderTraining()
    steps: Count = 20_000
    batch: Count = 512
    rate: Positive = 5e-4
    warmup: Count = 500
    decay: Annotated[float, Field(ge=0.0)] = 1e-2
    clip: Positive = 1.0
    ema: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.999
    precision: Literal["float32", "bfloat16"] = "float32"
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    weights: dict[str, Annotated[float, Field(ge=0.0)]] = {}
    mirror: MirrorConfig | None = None
    held_out: Share = 0.02
    units: Count = 1_000_000
    log_every: Count = 100
    save_every: Positive = 120.0
    validate_every: Count = 2000
    proposals: Count = 8
    judged: SamplingConfig = SamplingConfig()
    sampling: SamplingConfig = SamplingConfig()

    @property
    def sources(self) -> tuple[str, ...]:
        """All data sets."""
        return (self.data,) if isinstance(self.data, str) else self.data

    @property
    def essence(self) -> str:
        """What decides the weights, as text: all but how often things are logged, saved and judged, and from where."""
        return self.model_dump_json(
            exclude={
                "data", "robot", "cases", "log_every", "save_every", "validate_every", "proposals", "judged",
                "sampling",
            }
        )  # fmt: skip

    @classmethod
    def read(cls, path: str | os.PathLike[str], changes: Mapping[str, Any] | None = None) -> TrainingConfig:
        """Read a configuration; ``changes`` are put over it, by dotted keys.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It does not follow the schema.
        """
        data = read_yaml(Path(path), "training configuration")
        if data.get("schema") != SCHEMA:
            raise FileFormatError(str(path), "schema", data.get("schema"), f"expected {SCHEMA!r}")
        for key, value in (changes or {}).items():
            *above, last = key.split(".")
            place = data
            for name in above:
                place = place.setdefault(name, {})
                if not isinstance(place, dict):
                    raise FileFormatError(str(path), key, value, f"expected {name!r} to hold keys")
            place[last] = value
        return validate(cls, data, str(path))
