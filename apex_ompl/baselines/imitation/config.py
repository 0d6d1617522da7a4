"""Configuration of an imitation policy, and of its training, a YAML file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from apex_ompl.model.config import Count, Size
from apex_ompl.training.config import Positive, TrainingFile
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

    Those of every training are described in :class:`~apex_ompl.training.config.TrainingFile`.

    Attributes:
        schema_: Version of the format.
        network: The transformer.
        init: Folder of a policy whose weights are the first ones, where their shapes are the same; random by default.
        steps: Number of steps. It may be changed until ``cooldown`` steps before the end, as all before is the same.
        batch: Paths in a step.
        windows: Windows of each path in a step: times at which the policy is asked for the states that follow.
        noise: Standard deviation of the noise on the states that the policy is shown [rad].
        rate: Largest learning rate; it rises linearly over ``warmup`` steps, and falls linearly to 0 at the end.
        warmup: Number of steps of the rise.
        cooldown: Number of steps of the fall.
    """

    schema_: Literal["apex-ompl/imitation-training/1"] = Field(alias="schema")
    network: NetworkConfig
    init: str | None = None
    steps: Count = 10_000
    batch: Count = 32
    windows: Count = 8
    noise: Annotated[float, Field(ge=0.0)] = 0.02
    rate: Positive = 1e-3
    warmup: Count = 200
    cooldown: Count = 1500

    @property
    def determining(self) -> str:
        """Settings that determine the trained weights, as JSON: all but paths, the end, logging and saving."""
        return self.model_dump_json(exclude={"data", "robot", "init", "steps", "cooldown", "log_every", "save_every"})
