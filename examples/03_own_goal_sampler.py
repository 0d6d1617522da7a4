"""A goal of your own: an object that draws states which reach it.

``sample(rng)`` returns a state, or nothing where it finds none. Up to eight free ones are the goals of the plan.
"""

import numpy as np

import apex_ompl


class PalmAbove:
    """States in which the left palm is above a height, the right arm as at home."""

    def __init__(self, robot: apex_ompl.Robot, height: float) -> None:
        """Ask for a height [m]."""
        self.robot, self.height = robot, height

    def sample(self, rng: np.random.Generator) -> np.ndarray | None:
        """Return a random state around home if the palm is above the height there, shape (dof,)."""
        q = self.robot.home.copy()
        q[:7] += rng.normal(0.0, 0.5, 7)
        q = np.clip(q, self.robot.limits.lower, self.robot.limits.upper)
        return q if self.robot.link_pose(q, "left_hand_palm")[2, 3] > self.height else None


with apex_ompl.MotionPlanner() as planner:
    planner.world.add(name="post", box=(0.1, 0.1, 0.6), position=(0.5, 0.0, 0.3))
    height = planner.robot.link_pose(planner.robot.home, "left_hand_palm")[2, 3] + 0.2
    result = planner.plan(planner.robot.home, PalmAbove(planner.robot, height), timeout=20.0, seed=1)
print(result)
assert result and planner.robot.link_pose(result.path.states[-1], "left_hand_palm")[2, 3] > height
