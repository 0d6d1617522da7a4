"""A model that is told the constraints of a path, made of the shipped one.

What constraints tell (:func:`benchmarks.model.constrained_data.told`) is appended to the features of the scene. The
first layer of the encoder of conditions has a column for each, zero at the start of training: a linear embedding, added
to the layer's output, which leaves the outputs of the shipped model as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel
from apex_ompl.model.array_model import ArrayModel
from apex_ompl.model.checkpoint import read_checkpoint
from apex_ompl.model.query import Query
from apex_ompl.model.scene_encoding import SceneEncoding
from apex_ompl.types import Array

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from apex_ompl.training.conditions import Conditions
    from apex_ompl.training.latent_diffusion import LatentDiffusion
    from apex_ompl.training.records import Paths
    from apex_ompl.training.training import Trainer

LAYER = "encoder.phi.0.weight"


@dataclass(frozen=True, eq=False)
class ToldEncoding(SceneEncoding):
    """Features of a scene, to which those of constraints are appended.

    Attributes:
        told: Features of the constraints of the next queries, shape (T,).
    """

    told: NDArray[np.float32] = field(kw_only=True)

    def features(self, queries: Sequence[Query], kernel: Kernel) -> NDArray[np.float32]:
        """Return the features of queries under the same constraints, shape (Q, F + T)."""
        scene = super().features(queries, kernel)
        return np.concatenate([scene, np.tile(self.told, (len(queries), 1))], axis=1)


def load(folder: Path, robot: str) -> ArrayModel:
    """Return the model of a checkpoint, with inputs for constraints where its weights have columns for them.

    Args:
        folder: Folder of the checkpoint.
        robot: Name of the robot.

    Raises:
        MissingFileError, FileFormatError: It cannot be read.
    """
    config, weights, _ = read_checkpoint(folder, robot)
    model = ArrayModel(config.model, weights, config.trained)
    encoding = model.scene_encoding
    count = weights[LAYER].shape[1] - 2 * len(config.model.joints) - config.model.scene_features
    if count and encoding is not None:
        told = np.zeros(count, np.float32)
        model.scene_encoding = ToldEncoding(encoding.keys, encoding.probes, encoding.hands, told=told)
    return model


def tell(model: ArrayModel, told: Array) -> None:
    """Set what a model is told of constraints, shape (T,), if it has inputs for that."""
    if isinstance(model.scene_encoding, ToldEncoding):
        model.scene_encoding.told[:] = told


def widen(network: LatentDiffusion, count: int) -> None:
    """Add inputs to the encoder of conditions, whose weights are zero."""
    import torch
    from torch import nn

    before = network.encoder.phi[0]
    assert isinstance(before, nn.Linear)
    after = nn.Linear(before.in_features + count, before.out_features)
    with torch.no_grad():
        after.weight.zero_()
        after.weight[:, : before.in_features] = before.weight
        after.bias.copy_(before.bias)
    network.encoder.phi[0] = after


Batch = Callable[["NDArray[np.int64]", "torch.Generator"], "tuple[Tensor, Conditions]"]
"""Returns control points and conditions of paths by their indices."""


def told_batch(
    batch: Batch, table: Tensor, which: NDArray[np.int64], generator: torch.Generator
) -> tuple[Tensor, Conditions]:
    """Return a batch whose conditions have the features of constraints, too, of a table of shape (N, T) by path."""
    import torch

    control, conditions = batch(which, generator)
    features = torch.cat([conditions.features, table[torch.from_numpy(which)]], dim=1)
    return control, replace(conditions, features=features)


def told_table(paths: Paths, told: Mapping[str, Array]) -> Tensor:
    """Return the features of constraints of each path, shape (N, T), from those by the held objects of a problem."""
    import torch

    rows = np.array([told[text] for text in paths.names["held"]], np.float32)
    return torch.from_numpy(rows[paths.arrays["held"][paths.arrays["problem"]]])


def told_trainer(told: Mapping[str, Array]) -> type[Trainer]:
    """Return a trainer of models that are told constraints, for data of one shard without mirror images.

    Args:
        told: What they are told, shape (T,), by the held objects of a problem, as data sets name them.
    """
    import torch

    from apex_ompl.training.data import shard_paths, split
    from apex_ompl.training.latent_diffusion import LatentDiffusion
    from apex_ompl.training.training import Trainer

    count = len(next(iter(told.values())))

    class ToldTrainer(Trainer):
        """Training run of a model that is told constraints."""

        def _start_phase(self) -> None:
            """Add the inputs, and begin."""
            widen(self.network, count)
            super()._start_phase()
            paths, _ = shard_paths(self.config.sources, self.config.seed, self.config.units, 0)
            shards = self.data.shard, self.data.validation
            for shard, some in zip(shards, split(paths, self.config.held_out), strict=True):
                if shard is not None:
                    shard.batch = partial(told_batch, shard.batch, told_table(some, told))  # type: ignore[method-assign]

        def averaged_network(self) -> LatentDiffusion:
            """Return a model with the averaged weights."""
            with torch.random.fork_rng(devices=[]):
                network = LatentDiffusion(self.network.config)
                widen(network, count)
            network.load_state_dict({**self.network.state_dict(), **self.averaged})
            return network.eval()

    return ToldTrainer
