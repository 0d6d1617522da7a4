"""A variational autoencoder of single states, evaluated by NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array

LAYERS = ("encoder.0", "encoder.2", "encoder.4", "decoder.0", "decoder.2", "decoder.4")
"""Names of the dense layers, as those of :class:`apex_ompl.baselines.damon.manifold_training.StateNetwork`."""


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
