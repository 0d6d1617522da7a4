"""The learned manifold of DAMON: an autoencoder of states, evaluated by NumPy, the graph on it, and their files."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from safetensors.numpy import save as save_arrays

from apex_ompl.baselines import weights_folder
from apex_ompl.baselines.damon.lazy_search import Graph
from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.model.checkpoint import CONFIG, WEIGHTS, FolderCache, read_weights
from apex_ompl.types import Array, Indices
from apex_ompl.util.files import is_file, make_folder, write_atomically
from apex_ompl.util.schema import StrictModel, read_record

LAYERS = ("encoder.0", "encoder.2", "encoder.4", "decoder.0", "decoder.2", "decoder.4")
"""Names of the dense layers, as those of :class:`apex_ompl.baselines.damon.manifold_training.StateNetwork`."""
SCHEMA = "apex-ompl/manifold/1"
CARD = "README.md"
MADE_BY = "python scripts/train_damon.py"
DECODED, STORED = "decoded", "stored"
MOST_NODES = 65_535  # edges are stored in 16 bits


@dataclass(frozen=True, eq=False)
class StateAutoencoder:
    """Encoder and decoder of states, each two hidden layers with SiLU between.

    Both work on states that are scaled to -1 .. 1 by the limits.

    Attributes:
        weights: Weights and biases by the names of :data:`LAYERS`.
        lower: Lowest positions of the joints, shape (J,) [rad].
        upper: Highest ones, shape (J,) [rad].
    """

    weights: Mapping[str, NDArray[np.float32]]
    lower: Array
    upper: Array

    @property
    def dim(self) -> int:
        """Dimension of the latent space."""
        return int(self.weights["decoder.0.weight"].shape[1])

    def encode(self, states: Array) -> Array:
        """Return the means of q(z | x) of states, shape (N, J); shape (N, dim)."""
        scaled = 2.0 * (states - self.lower) / (self.upper - self.lower) - 1.0
        return self._run("encoder", scaled)[:, : self.dim]

    def decode(self, latent: Array) -> Array:
        """Return states inside the limits, shape (N, J), of latent vectors, shape (N, dim)."""
        scaled = np.clip(self._run("decoder", latent), -1.0, 1.0)
        return np.clip(self.lower + 0.5 * (scaled + 1.0) * (self.upper - self.lower), self.lower, self.upper)

    def _run(self, half: str, x: Array) -> Array:
        names = [name for name in LAYERS if name.startswith(half)]
        for name in names:
            x = x @ self.weights[f"{name}.weight"].T.astype(float) + self.weights[f"{name}.bias"].astype(float)
            if name != names[-1]:
                x = x / (1.0 + np.exp(-x))
        return x


def weight_shapes(joints: int, hidden: int, dim: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the weights by name."""
    sizes = ((joints, hidden), (hidden, hidden), (hidden, 2 * dim), (dim, hidden), (hidden, hidden), (hidden, joints))
    found: dict[str, tuple[int, ...]] = {}
    for name, (before, after) in zip(LAYERS, sizes, strict=True):
        found |= {f"{name}.weight": (after, before), f"{name}.bias": (after,)}
    return found


class ManifoldConfig(StrictModel):
    """Content of ``config.json``.

    Attributes:
        schema_: Version of the format.
        robot: Name of the robot.
        joints: Joints that the manifold has values of.
        dim: Dimension of the latent space.
        hidden: Width of the hidden layers.
        digest: SHA-256 of the file of weights.
        trained: Record of the training.
    """

    schema_: Literal["apex-ompl/manifold/1"] = Field(alias="schema")
    robot: str
    joints: tuple[str, ...]
    dim: int = Field(ge=1, le=64)
    hidden: int = Field(ge=1, le=4096)
    digest: str
    trained: dict[str, Any] = {}


@dataclass(frozen=True, eq=False)
class Manifold:
    """An autoencoder of states, and a graph of nodes of its latent space.

    Attributes:
        config: What it is of.
        autoencoder: The autoencoder.
        latent: Latent vectors of the nodes, shape (N, d).
        stored: The states that these were encoded from, shape (N, J) [rad].
        pairs: Edges by kind of nodes, ``decoded`` and ``stored``, each of shape (M, 2).
    """

    config: ManifoldConfig
    autoencoder: StateAutoencoder
    latent: Array
    stored: Array
    pairs: Mapping[str, Indices]

    def states(self, kind: str) -> Array:
        """Return the states of the nodes, shape (N, J): decoded from their latent vectors, or those stored."""
        return self.autoencoder.decode(self.latent) if kind == DECODED else self.stored

    def graph(self, kind: str) -> Graph:
        """Return the graph of the nodes of a kind, ``decoded`` or ``stored``."""
        return _graph(self, kind)


def halved(weights: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Return weights as they are after they were stored in half precision."""
    return {name: value.astype(np.float16).astype(np.float32) for name, value in weights.items()}


def save_manifold(folder: str | os.PathLike[str], manifold: Manifold, trained: Mapping[str, Any]) -> None:
    """Write a manifold; the configuration last, so that a folder is complete or damaged by its digest.

    Raises:
        MissingFileError: The folder cannot be written.
    """
    path = make_folder(folder, "folder of a manifold")
    arrays: dict[str, NDArray[Any]] = {k: v.astype(np.float16) for k, v in manifold.autoencoder.weights.items()}
    arrays |= {"lower": manifold.autoencoder.lower, "upper": manifold.autoencoder.upper}
    arrays |= {"latent": manifold.latent.astype(np.float16), "stored": manifold.stored.astype(np.float16)}
    arrays |= {f"edges.{kind}": pairs.astype(np.uint16) for kind, pairs in manifold.pairs.items()}
    content = save_arrays(arrays)
    config = manifold.config.model_copy(
        update={"digest": hashlib.sha256(content).hexdigest(), "trained": dict(trained)}
    )
    write_atomically(path / WEIGHTS, content)
    write_atomically(path / CARD, card(manifold, trained).encode())
    text = json.dumps(config.model_dump(mode="json", by_alias=True), indent=1) + "\n"
    write_atomically(path / CONFIG, text.encode())


def card(manifold: Manifold, trained: Mapping[str, Any]) -> str:
    """Return the model card, Markdown."""
    config, counts = manifold.config, {kind: len(pairs) for kind, pairs in manifold.pairs.items()}
    lines = [
        f"# A manifold of states of {config.robot} in {config.dim} dimensions",
        "",
        f"A variational autoencoder of {len(config.joints)} joints, {config.hidden} units in two hidden layers, and "
        f"{len(manifold.latent)} nodes of its latent space with {counts[DECODED]} edges between decoded states and "
        f"{counts[STORED]} between stored ones. For the planner `damon`, a baseline; see `docs/baselines.md`.",
        "",
        f"Made by `{MADE_BY}`: " + ", ".join(f"{key} {value}" for key, value in trained.items()) + ".",
        "",
    ]
    return "\n".join(lines)


def folder_of(name: str) -> Path:
    """Return the folder of a manifold: one of the source tree's ``benchmarks/baselines`` by name, or a path.

    Raises:
        MissingFileError: There is none.
    """
    for folder in (weights_folder(name), Path(name)):
        if is_file(folder / CONFIG):
            return folder
    why = f"no folder of the tree's benchmarks/baselines, nor a path; `{MADE_BY}` makes damon-2, damon-4 and damon-8"
    raise MissingFileError(name, "manifold of the planner damon", why)


def load_manifold(name: str, robot: str | None = None) -> Manifold:
    """Return a manifold by the name of its folder, or by a path.

    Args:
        name: For example ``damon-2``.
        robot: Name of the robot that it must be for; by default any.

    Raises:
        MissingFileError: There is none.
        FileFormatError: It is damaged, of another version, or for another robot.
    """
    folder = folder_of(name)
    config = read_record(folder / CONFIG, ManifoldConfig, "configuration of a manifold")
    if robot is not None and config.robot != robot:
        raise FileFormatError(str(folder / CONFIG), "robot", config.robot, f"expected {robot!r}")
    source = folder / WEIGHTS
    arrays = read_weights(source, config.digest, "weights of a manifold")
    fault = _fault(arrays, config)
    if fault:
        raise FileFormatError(str(source), fault, "values that do not fit", f"expected arrays that fit {CONFIG}")
    weights = {key: arrays[key].astype(np.float32) for key in weight_shapes(len(config.joints), config.hidden, 1)}
    autoencoder = StateAutoencoder(weights, arrays["lower"].astype(float), arrays["upper"].astype(float))
    pairs = {kind: arrays[f"edges.{kind}"].astype(np.int64) for kind in (DECODED, STORED)}
    return Manifold(config, autoencoder, arrays["latent"].astype(float), arrays["stored"].astype(float), pairs)


def shared_manifold(name: str, robot: str | None = None) -> Manifold:
    """Return a manifold from a cache; it is read again when its files change.

    Raises:
        ApexError: As :func:`load_manifold` does.
    """
    return _shared(folder_of(name), robot=robot)


_shared = FolderCache(load_manifold)


@lru_cache(maxsize=4)
def _graph(manifold: Manifold, kind: str) -> Graph:
    return Graph.of(manifold.states(kind), manifold.pairs[kind])


def _fault(arrays: Mapping[str, NDArray[Any]], config: ManifoldConfig) -> str:
    """Return the name of the array that is missing or does not fit the others, or an empty text."""
    joints, nodes = len(config.joints), len(arrays.get("latent", ()))
    shapes: dict[str, tuple[int, ...]] = {
        **weight_shapes(joints, config.hidden, config.dim), "lower": (joints,), "upper": (joints,),
        "latent": (nodes, config.dim), "stored": (nodes, joints),
    }  # fmt: skip
    for name, shape in shapes.items():
        if name not in arrays or arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            return name
    for kind in (DECODED, STORED):
        name = f"edges.{kind}"
        pairs = arrays.get(name)
        if pairs is None or pairs.ndim != 2 or pairs.shape[1] != 2 or (len(pairs) and int(pairs.max()) >= nodes):
            return name
    return "" if 0 < nodes <= MOST_NODES else "latent"
