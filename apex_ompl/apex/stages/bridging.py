"""Bridges: blocked stretches of the best candidates, joined by short trees."""

from __future__ import annotations

from dataclasses import dataclass

from apex_ompl.apex.bridge import MAX_CALLS, bridge_blocked, every_other
from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.stage import Solution
from apex_ompl.paths.path import Path

MAX_BRIDGED = 2  # candidates


@dataclass(frozen=True)
class Bridging:
    """Short trees between the free stretches of the best candidates.

    Attributes:
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        calls: Iterations of one bridge, at most.
    """

    tree_range: float
    calls: int = MAX_CALLS

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first candidate whose blocked stretches are bridged, or None."""
        for candidate in sorted(context.pool.candidates, key=lambda one: one.clearance_cost)[:MAX_BRIDGED]:
            if context.stop():
                return None
            with context.report.timed("bridge"):
                states = every_other(context.spline_path(candidate.control).states)
                found = bridge_blocked(context, states, self.tree_range, calls=self.calls)
            if found is not None:
                return Solution(Path(found), "apex+bridge")
        return None
