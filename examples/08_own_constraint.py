"""A constraint of your own along the path: both shoulders turn as mirror images of each other.

A constraint is an object with a residual r(q), its Jacobian, a tolerance, and a bound on |r| over straight pieces of
the path, by which it is proved between states, too.
"""

import numpy as np

from apex_ompl import load_problem, plan


class Mirrored:
    """The sum of the first joints of both arms stays as at the start."""

    name, tolerance = "mirrored shoulders", 0.01

    def __init__(self, start: np.ndarray) -> None:
        """Keep the sum of a start, shape (dof,)."""
        self.row = np.zeros((1, len(start)))
        self.row[0, [0, 7]] = 1.0
        self.sum = self.row @ start

    def residual(self, q: np.ndarray) -> np.ndarray:
        """Return the residual, shape (1,)."""
        return self.row @ q - self.sum

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return its derivative, shape (1, dof)."""
        return self.row

    def bound(self, q: np.ndarray, step: np.ndarray) -> float:
        """Return a bound on the norm over q + u step, |u| <= 1."""
        return float((np.abs(self.residual(q)) + np.abs(self.row @ step)).sum())


problem = load_problem("ball_in_cup")
result = plan(problem, constraints=[Mirrored(np.array(list(problem.start.values())))])
print(result)
assert result and result.constraint_bound["mirrored shoulders"] <= Mirrored.tolerance
