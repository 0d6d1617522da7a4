"""Memory that searches in compiled code work with: what the proof of a motion needs."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.motion_proof import OPEN_STATES, PROVED_INTERVALS, PROVED_STATES, TRIED_INTERVALS
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array


class SearchCounts(NamedTuple):
    """What a search looked at.

    Attributes:
        proved: States that were proved free.
        blocked: States that were not, and count as blocked.
        intervals: Intervals of motions that were tried as a whole.
        proved_intervals: Those that were proved.
    """

    proved: int
    blocked: int
    intervals: int
    proved_intervals: int


class SearchBuffers:
    """Buffers for proofs of straight motions, see :func:`apex_ompl.kernel.compiled.motion_proof.prove_path`.

    Attributes:
        workspace: Workspace of the robot.
        proof: Motion, its grid, queue, ends, state, pairs and counts, as compiled code takes them.
    """

    def __init__(self, kernel: Kernel, longest: float, resolution: float) -> None:
        """Make room for motions up to ``longest`` [rad, max-norm] whose states are ``resolution`` apart [rad]."""
        dof, steps = kernel.robot.dof, math.ceil(longest / resolution) + 1
        self.workspace = kernel.workspace()
        self._counts: NDArray[np.int64] = np.zeros(5, np.int64)
        self.proof: tuple[Array | NDArray[Any], ...] = (
            np.empty((2, dof)), np.empty(2, np.int64), np.empty((2 * steps + 4, 2), np.int64), np.empty(3, np.int64),
            np.empty(dof), np.empty((1, 2), np.int64), self._counts,
        )  # fmt: skip

    def take_counts(self) -> SearchCounts:
        """Return what was looked at since the last call."""
        c = self._counts.tolist()
        self._counts[:] = 0
        return SearchCounts(c[PROVED_STATES], c[OPEN_STATES], c[TRIED_INTERVALS], c[PROVED_INTERVALS])
