"""Training of a variational autoencoder of single states."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from apex_ompl.baselines.damon.latent_graph import StateSample
from apex_ompl.training.records import Paths
from apex_ompl.types import Array, Indices

RATE, BATCH = 2e-3, 1024
HELD_OUT = 50  # one path of so many is left out of training


class StateNetwork(nn.Module):
    """Encoder J -> hidden -> hidden -> 2 dim, mean and log variance; decoder dim -> hidden -> hidden -> J."""

    def __init__(self, joints: int, hidden: int, dim: int) -> None:
        """Make the layers."""
        super().__init__()

        def layers(before: int, after: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Linear(before, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(), nn.Linear(hidden, after)
            )

        self.encoder, self.decoder = layers(joints, 2 * dim), layers(dim, joints)

    def loss(self, x: Tensor, noise: Tensor, beta: float) -> Tensor:
        """Return the negative evidence lower bound (Kingma and Welling 2014, "Auto-encoding variational Bayes").

        With mu and sigma of q(z | x), z = mu + sigma noise, and means over all entries:

        loss = mean((decode(z) - x)^2) + beta * mean((mu^2 + sigma^2 - 1 - log sigma^2) / 2)

        Args:
            x: States scaled to -1 .. 1, shape (B, J).
            noise: Standard normal, shape (B, dim).
            beta: Weight of the divergence.
        """
        mean, log_variance = self.encoder(x).chunk(2, dim=1)
        log_variance = log_variance.clamp(-20.0, 10.0)
        decoded = self.decoder(mean + (0.5 * log_variance).exp() * noise)
        divergence = 0.5 * (mean**2 + log_variance.exp() - 1.0 - log_variance)
        found: Tensor = torch.mean((decoded - x) ** 2) + beta * divergence.mean()
        return found


def train(
    states: Array, lower: Array, upper: Array, *, dim: int, hidden: int = 64, beta: float = 1e-3, epochs: int = 20,
    seed: int = 0, progress: Callable[[int, float], None] = lambda epoch, loss: None,
) -> dict[str, NDArray[np.float32]]:  # fmt: skip
    """Return the weights of a network trained on states, by Adam with a rate that falls to zero as a cosine.

    Args:
        states: Shape (N, J) [rad].
        lower: Lowest positions of the joints, shape (J,) [rad].
        upper: Highest ones, shape (J,) [rad].
        dim: Dimension of the latent space.
        hidden: Width of the hidden layers.
        beta: Weight of the divergence.
        epochs: Number of passes over the states.
        seed: Of first weights, order and noise.
        progress: Called after each pass with its number and mean loss.
    """
    x = torch.tensor(2.0 * (states - lower) / (upper - lower) - 1.0, dtype=torch.float32)
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = StateNetwork(x.shape[1], hidden, dim)
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    steps = epochs * -(-len(x) // BATCH)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for epoch in range(epochs):
        total = 0.0
        for which in torch.split(torch.randperm(len(x), generator=generator), BATCH):
            loss = network.loss(x[which], torch.randn(len(which), dim, generator=generator), beta)
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
            total += float(loss.detach()) * len(which)
        progress(epoch, total / len(x))
    return {name: value.detach().numpy().copy() for name, value in network.state_dict().items()}


def sample_states(paths: Paths, joints: Indices, count: int, along: int, seed: int) -> StateSample:
    """Return states evenly spaced along paths drawn at random, about ``count`` of them.

    Args:
        paths: The paths.
        joints: Which joints are wanted, shape (J,).
        count: Number of states; less where there are not enough paths.
        along: Number of states of a path, both ends among them.
        seed: Of the choice of paths.
    """
    wanted = min(len(paths), -(-count // along))
    chosen = np.sort(np.random.default_rng(seed).permutation(len(paths))[:wanted])
    spline = paths.spline
    basis = spline.basis(np.linspace(0.0, 1.0, along))
    states = (basis @ paths.control(chosen))[:, :, joints]
    return StateSample(states.reshape(-1, len(joints)), np.repeat(np.arange(wanted), along))


def split_sample(sample: StateSample) -> tuple[StateSample, StateSample]:
    """Return the states of most paths, and those of every 50th, which is held out."""
    out = sample.paths % HELD_OUT == HELD_OUT - 1
    return (
        StateSample(sample.states[~out], sample.paths[~out]),
        StateSample(sample.states[out], sample.paths[out]),
    )
