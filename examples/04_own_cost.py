"""A cost of your own in the trajectory optimizer: the arms stay close to their home posture along the path.

A cost term is a function of states, shape (N, dof), that returns residuals, shape (N, m), and their Jacobians, shape
(N, m, dof). Half the mean squared norm of the residuals is added to the cost of the path.
"""

import numpy as np

from apex_ompl import load_problem
from apex_ompl.ompl import assemble
from apex_ompl.paths import Optimizer

WEIGHT = 0.3

ready = assemble(load_problem("ball_in_cup"))
kernel, checker, home = ready.checker.kernel, ready.checker, ready.robot.home


def stay_near_home(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return WEIGHT (q - home), and WEIGHT times the identity."""
    return WEIGHT * (states - home), np.tile(WEIGHT * np.eye(len(home)), (len(states), 1, 1))


for name, costs in (("without", []), ("with", [stay_near_home])):
    optimizer = Optimizer(costs=costs)
    line = optimizer.spline.line(ready.start, ready.goals[0])
    control = optimizer.shorten(kernel, line, lambda path: checker.first_collision(path, 0.01) is None)
    assert control is not None, "no valid path"
    distance = np.linalg.norm(optimizer.spline.path(control) - home, axis=1).mean()
    print(f"{name} the term: mean distance from home {distance:.3f} rad")
