"""A stage of your own in APEX: by way of taught postures, before APEX's own stages.

A stage has one method, ``run(context)``. It returns a path or its states, which are checked, or nothing.
"""

from collections.abc import Sequence

import numpy as np

import apex_ompl
from apex_ompl import planners
from apex_ompl.apex import ApexParameters, SolveContext


class ByWayOf:
    """Straight lines from the start to a posture that was taught, and from there to the goal."""

    def __init__(self, postures: Sequence[np.ndarray]) -> None:
        """Try some postures, each of shape (dof,)."""
        self.postures = postures

    def run(self, context: SolveContext) -> np.ndarray | None:
        """Return the first path that is valid, shape (3, dof)."""
        for start, goal in context.pairs:
            for posture in self.postures:
                states = np.stack([start, posture, goal])
                if not context.stop() and context.is_valid(states):
                    return states
        return None


home = apex_ompl.load_robot("dual_panda_softhand").home
stages = [ByWayOf([home]), *ApexParameters().stages()]
result = apex_ompl.plan("wall/easy/800000", lambda si: planners.APEX(si, stages=stages), timeout=20.0)
print(result)
assert result and result.solved_by == "ByWayOf"
