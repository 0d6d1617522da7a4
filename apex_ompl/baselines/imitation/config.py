"""Configuration of an imitation policy, and of its training, a YAML file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from apex_ompl.model.config import Count, Size
from apex_ompl.training.config import MirrorConfig, Positive, Share, TrainingFile
from apex_ompl.util.schema import StrictModel


class NetworkConfig(StrictModel):
    """Transformer of a policy, see ``apex_ompl.baselines.imitation.network.PolicyNetwork``.

    Attributes:
        obstacles: ``set`` for a token for each obstacle, ``point`` for one of the obstacle point of the paper.
        groups: Joints of each state token and of each goal token, for example the two arms and the hands.
        width: Width of the tokens.
        layers: Number of layers.
        heads: Number of attention heads.
        chunk: Number of next states that are predicted at a time.
        clock: Number of states of a path.
    """

    obstacles: Literal["set", "point"] = "set"
    groups: Annotated[tuple[tuple[Annotated[int, Field(ge=0)], ...], ...], Field(min_length=1)]
    width: Size = 192
    layers: Annotated[int, Field(ge=1, le=64)] = 4
    heads: Size = 8
    chunk: Size = 16
    clock: Annotated[Size, Field(ge=2)] = 256

    @model_validator(mode="after")
    def _fits(self) -> NetworkConfig:
        if self.width % self.heads:
            raise ValueError("expected a width that is a multiple of the number of heads")
        if sorted(j for group in self.groups for j in group) != list(range(sum(map(len, self.groups)))):
            raise ValueError("expected every joint's number once in the groups")
        if not all(self.groups):
            raise ValueError("expected groups of at least one joint")
        return self

    @property
    def dof(self) -> int:
        """Number of joints."""
        return sum(map(len, self.groups))


class ImitationConfig(TrainingFile):
    """Configuration of ``scripts/train_il.py``; attributes are keys of the file.

    Attributes:
        schema_: Version of the format.
        data: Folder of a data set, or a file of paths; or several.
        robot: File of the robot's kernel tables.
        network: The transformer.
        init: Folder of a policy whose weights are the first ones, where their shapes are the same; random by default.
        steps: Number of steps. It may be changed until ``cooldown`` steps before the end, as all before is the same.
        batch: Paths in a step.
        windows: Windows of each path in a step: times at which the policy is asked for the states that follow.
        noise: Standard deviation of the noise on the states that the policy is shown [rad].
        rate: Largest learning rate; it rises linearly over ``warmup`` steps, and falls linearly to 0 at the end.
        warmup: Number of steps of the rise.
        cooldown: Number of steps of the fall.
        decay: Weight decay.
        clip: Largest norm of the gradient.
        ema: Decay of the exponential moving average of the weights.
        precision: ``float32`` or ``bfloat16`` (mixed).
        seed: Seed of all random choices.
        weights: Relative frequency of paths, by patterns of ``suite/level``; the first that matches counts, else 1.
        mirror: Mirror symmetry of the robot, by which the data are augmented.
        held_out: Share of the problems kept for the validation loss.
        log_every: Steps between two lines of the log.
        save_every: Seconds between two saves.
    """

    schema_: Literal["apex-ompl/imitation-training/1"] = Field(alias="schema")
    data: str | Annotated[tuple[str, ...], Field(min_length=1)]
    robot: str
    network: NetworkConfig
    init: str | None = None
    steps: Count = 10_000
    batch: Count = 32
    windows: Count = 8
    noise: Annotated[float, Field(ge=0.0)] = 0.02
    rate: Positive = 1e-3
    warmup: Count = 200
    cooldown: Count = 1500
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

    @property
    def determining(self) -> str:
        """Settings that determine the trained weights, as JSON: all but paths, the end, logging and saving."""
        return self.model_dump_json(exclude={"data", "robot", "init", "steps", "cooldown", "log_every", "save_every"})
