"""Shortcuts along paths, in compiled code."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from apex_ompl.kernel.compiled.shortcutting import shortcut_path
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.search_buffers import SearchBuffers, SearchCounts
from apex_ompl.types import Array

TRIES, DRAWS = 64, 16  # motions between corners, and draws, between two looks at the clock
ENOUGH = 100  # draws for a path of trees
RESOLUTION = 0.01  # of the states along shortcuts of such a path [rad, max-norm]


def shortcut(
    kernel: Kernel, path: Array, draws: int, resolution: float, rng: np.random.Generator,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Array, SearchCounts]:  # fmt: skip
    """Return a path with the same ends that is no longer, and what was looked at.

    First as many corners as possible are left out, then straight motions between two random places along the path take
    the place of what is between them, where the kernel proves them free (Geraerts and Overmars, 2007), and corners are
    left out again.

    Args:
        kernel: The robot among its obstacles.
        path: Corners of the path, shape (N, dof).
        draws: Number of random shortcuts that are tried.
        resolution: Largest spacing of the states that are checked along them [rad, max-norm].
        rng: Source of the places.
        stop: Asked from time to time whether to leave it as it is by then.
    """
    states = kernel.states(path)
    extent = float(np.ptp(states, axis=0).max(initial=0.0))
    buffers = SearchBuffers(kernel, max(extent, resolution), resolution)
    room = np.concatenate([states, np.zeros((len(states) + 16, states.shape[1]))])
    progress, places = np.array([len(states), 0, TRIES]), rng.random((draws, 2))

    def advance(some: Array) -> None:
        shortcut_path(*kernel.packed, *buffers.workspace, some, float(resolution), room, progress, *buffers.proof)

    def leave_out() -> None:
        progress[1] = 0
        while progress[1] < progress[0] - 2 and not stop():
            advance(places[:0])

    leave_out()
    for first in range(0, draws, DRAWS):
        if stop():
            break
        advance(places[first : first + DRAWS])
    leave_out()
    count = int(progress[0])
    short = np.concatenate([states[:1], room[1 : count - 1], states[-1:]]) if count > 1 else states
    return short, buffers.take_counts()
