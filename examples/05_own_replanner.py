"""A replanner of your own in the closed loop: the fastest direct motion to a goal, taken where it is proved.

Where it finds none, the robot follows its last motion as long as that has a proved stop, and asks again.

Usage: python examples/05_own_replanner.py
"""

from __future__ import annotations

import apex_ompl
from apex_ompl.moving import Answer, ComputeBudget, Request, RunContext, Search


class DirectMotions:
    """Plans direct motions from the state that the robot will have."""

    def prepare(self, context: RunContext) -> None:
        """Nothing needs to be loaded."""

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Answer:
        """Return the first direct motion that is proved among the predicted obstacles, or none."""
        search = Search(context, request, budget)
        for goal in search.goals:  # the nearest first
            motion = search.direct(goal)
            if motion is not None and search.accepts(motion):
                return Answer(search.following(motion), "direct", budget)
        return Answer(None, "an obstacle is in the way of each direct motion", budget)


if __name__ == "__main__":
    print(apex_ompl.run("turning/vertical/medium/800001", DirectMotions(), seed=0))
