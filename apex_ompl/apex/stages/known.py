"""Known candidates: straight lines and earlier paths, which cost nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.stage import Solution, solution_of
from apex_ompl.paths.candidates import Candidate
from apex_ompl.types import Array

LINE, EXPERIENCE = "line", "experience"


@dataclass(frozen=True)
class KnownCandidates:
    """Check the straight lines, and earlier paths moved to other ends; invalid ones wait for repair.

    Attributes:
        line: Whether straight lines are candidates.
    """

    line: bool

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first known candidate that is valid, or None."""
        with context.report.timed("known"):
            for start, goal in context.pairs:
                for origin, control in self._candidates(context, start, goal):
                    if context.stop():
                        return None
                    context.report.candidates += 1
                    candidate = Candidate(control, origin, np.inf, np.inf, 0.0)
                    if self._may_be_valid(context, origin, start, goal):
                        states = context.optimizer.spline.path(control)
                        if context.is_valid(states) and context.accepts_distance(candidate, states):
                            return solution_of(candidate, context)
                    context.unchecked.append((origin, control))
        return None

    def _candidates(self, context: SolveContext, start: Array, goal: Array) -> list[tuple[str, Array]]:
        spline, limits = context.optimizer.spline, context.kernel.robot.arrays
        line = spline.line(start, goal)
        found = [(LINE, line)] if self.line else []
        for residual in context.experience:
            moved = np.clip(line + residual, limits.lower, limits.upper)
            found.append((EXPERIENCE, spline.with_ends(moved, start, goal)))
        return found

    @staticmethod
    def _may_be_valid(context: SolveContext, origin: str, start: Array, goal: Array) -> bool:
        """Whether a candidate is worth its full check: a straight line is soon rejected by its two ends."""
        if origin == EXPERIENCE:
            return True
        line = np.stack([start, goal])
        return not any(np.array_equal(line, other) for other in context.rejected_lines) and context.is_valid(line)


@dataclass(frozen=True)
class CheckKnown:
    """Take the known candidates that were not valid into the pool, where repair finds them."""

    def run(self, context: SolveContext) -> Solution | None:
        """Return a known candidate that is valid after all, or None."""
        known, context.unchecked = context.unchecked, []
        for origin in dict.fromkeys(origin for origin, _ in known):
            if not context.stop():
                with context.report.timed("check"):
                    mine = [control for its, control in known if its == origin]
                    found = solution_of(context.pool.add(mine, origin, context.stop), context)
                if found is not None:
                    return found
        return None
