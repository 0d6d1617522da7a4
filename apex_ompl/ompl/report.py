"""Reports of planners: what one call of ``solve`` did."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from apex_ompl.paths.path import Path
from apex_ompl.util.clocks import timed
from apex_ompl.util.display import fields_line


@dataclass
class SolveReport:
    """Outcome of one call of ``solve``, by stages.

    Attributes:
        solved_by: Stage that found the first valid path: ``line``, ``experience``, ``apex`` or ``apex+resample``,
            with ``+repair`` where the optimizer had to help; ``sprint``, ``apex+bridge`` or ``rrtconnect``; empty
            without one.
        reason: One sentence where there is no exact solution.
        times: Seconds by stage; those of ``guidance`` and ``distance`` are part of other stages.
        first: Seconds until the first valid path, NaN without one.
        first_verified: Whether the first valid path had passed the full check by then.
        first_path: First valid path, or None.
        best_path: Shortest valid path, or None.
        lengths: Time [s] and length [rad] of each path that was accepted as a solution.
        candidates: Number of candidates before trees: straight lines, earlier paths, proposals.
        proposed: Number of candidates that the model proposed.
        resampled: Number of candidates from collision-triggered resampling.
        steps: Number of optimizer steps in repair.
        improved: Number of shorter paths that were found after the first one.
    """

    solved_by: str = ""
    reason: str = ""
    times: dict[str, float] = field(default_factory=dict)
    first: float = float("nan")
    first_verified: bool = False
    first_path: Path | None = None
    best_path: Path | None = None
    lengths: list[tuple[float, float]] = field(default_factory=list)
    candidates: int = 0
    proposed: int = 0
    resampled: int = 0
    steps: int = 0
    improved: int = 0

    __repr__ = fields_line

    def timed(self, stage: str) -> AbstractContextManager[None]:
        """Count the time of a block to a stage."""
        return timed(self.times, stage)


@runtime_checkable
class ReportingPlanner(Protocol):
    """Planner that reports on its last call of ``solve``."""

    report: SolveReport


@runtime_checkable
class LineAwarePlanner(Protocol):
    """Planner that tries straight lines itself, and need not try those that were found invalid before ``solve``.

    Attributes:
        rejected_lines: Ends of the lines, each of shape (2, dof).
    """

    rejected_lines: list[Any]


def report_of(planner: Any) -> SolveReport | None:
    """Return the report of a planner that makes one, or None."""
    return planner.report if isinstance(planner, ReportingPlanner) else None
