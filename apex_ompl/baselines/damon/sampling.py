"""States of stored paths, to learn a manifold from."""

from __future__ import annotations

import numpy as np

from apex_ompl.baselines.damon.latent_graph import StateSample
from apex_ompl.training.records import Paths
from apex_ompl.types import Indices

HELD_OUT = 50  # one path of so many is left out of training


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
