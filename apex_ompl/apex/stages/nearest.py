"""Approximate solutions: the valid beginning of a candidate that ends nearest to a goal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from apex_ompl.apex.bridge import valid_prefix
from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.bridging import MAX_BRIDGED
from apex_ompl.apex.stages.stage import Solution
from apex_ompl.paths.path import Path


@dataclass(frozen=True)
class NearestToGoal:
    """Note the valid beginning of the best candidates that ends nearest to a goal."""

    def run(self, context: SolveContext) -> Solution | None:
        """Set ``context.nearest``; return None, since an approximate path solves nothing."""
        with context.report.timed("approximate"):
            for candidate in sorted(context.pool.candidates, key=lambda one: one.clearance_cost)[:MAX_BRIDGED]:
                states = valid_prefix(context.validator, context.spline_path(candidate.control).states, context.stop)
                distance = min(float(np.linalg.norm(goal - states[-1])) for goal in context.goals)
                if len(states) > 1 and (context.nearest is None or distance < context.nearest[1]):
                    context.nearest = Path(states), distance
        return None
