"""What a planner of this project says of its last call of ``solve``."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apex_ompl.util.stopwatch import timed


@dataclass
class Report:
    """What a call of ``solve`` did.

    Attributes:
        solved_by: The stage that found the first valid path: ``line``, ``experience``, ``apex`` or ``apex+resample``,
            with ``+repair`` where the optimiser had to help; ``sprint``, ``apex+bridge`` or ``rrtconnect``; empty
            without one.
        reason: One sentence where there is no exact solution.
        times: Seconds by stage; those of ``guidance`` and ``distance`` are part of other stages.
        first: Seconds until the first valid path, NaN without one.
        judged: Whether that had passed the full check by then.
        path: The first valid path, shape (N, dof), or None.
        lengths: Seconds, and length [rad], of each path that was taken as a solution.
        candidates: Paths that were looked at before trees: straight lines, earlier paths, proposals.
        proposed: Those of them that the model proposed.
        resampled: Those that it proposed on resampling.
        steps: Steps of the optimiser in repair.
        improved: How often a shorter path was found behind the first one.
    """

    solved_by: str = ""
    reason: str = ""
    times: dict[str, float] = field(default_factory=dict)
    first: float = float("nan")
    judged: bool = False
    path: NDArray[np.float64] | None = None
    lengths: list[tuple[float, float]] = field(default_factory=list)
    candidates: int = 0
    proposed: int = 0
    resampled: int = 0
    steps: int = 0
    improved: int = 0

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Count the time of a block to a stage."""
        return timed(self.times, stage)
