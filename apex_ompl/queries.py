"""Problems as the model sees them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import Verdict
from apex_ompl.collision.verdict import NO_POINT
from apex_ompl.diffusion.conditions import Query, Things

Array = NDArray[np.float64]


def query_of(verdict: Verdict, start: Array, goal: Array, *, point: bool = True) -> Query:
    """Return the query of going from a state to another, among the obstacles of now.

    Fixtures of the robot are left out. Meshes are seen as the boxes that the kernel takes them for.

    Args:
        verdict: The robot among obstacles.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        point: Whether the obstacle point is looked for; models that do not see it can do without.
    """
    things = Things.among(verdict.kernel.scene.arrays, verdict.movable)
    place = verdict.obstacle_point(start) if point else np.array(NO_POINT)
    return Query(np.asarray(start, float), np.asarray(goal, float), place, things)
