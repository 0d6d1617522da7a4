"""Shortcuts along paths, in compiled code."""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel.compiled.shortcutting import shortcut_path
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.search_buffers import SearchBuffers, SearchCounts
from apex_ompl.types import Array


def shortcut(
    kernel: Kernel, path: Array, draws: int, resolution: float, rng: np.random.Generator
) -> tuple[Array, SearchCounts]:
    """Return a path with the same ends that is no longer, and what was looked at.

    First as many corners as possible are left out, then straight motions between two random places along the path take
    the place of what is between them, where the kernel proves them free (Geraerts and Overmars, 2007).

    Args:
        kernel: The robot among its obstacles.
        path: Corners of the path, shape (N, dof).
        draws: Number of random shortcuts that are tried.
        resolution: Largest spacing of the states that are checked along them [rad, max-norm].
        rng: Source of the places.
    """
    states = kernel.states(path)
    extent = float(np.ptp(states, axis=0).max(initial=0.0))
    buffers = SearchBuffers(kernel, max(extent, resolution), resolution)
    room = np.concatenate([states, np.zeros((len(states) + 16, states.shape[1]))])
    count = shortcut_path(
        *kernel.packed, *buffers.workspace, rng.random((draws, 2)), float(resolution), room, len(states), *buffers.proof
    )
    return np.concatenate(
        [states[:1], room[1 : count - 1], states[-1:]]
    ) if count > 1 else states, buffers.take_counts()
