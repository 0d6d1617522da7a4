"""Problems as the model sees them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision import Verdict
from apex_ompl.diffusion.conditions import Query, Things

Array = NDArray[np.float64]


def query_of(verdict: Verdict, start: Array, goal: Array) -> Query:
    """Return the query of going from a state to another, each of shape (dof,), among the obstacles of now.

    Fixtures of the robot are left out. Meshes are seen as the boxes that the kernel takes them for.
    """
    things = Things.among(verdict.kernel.scene.arrays, verdict.movable)
    return Query(np.asarray(start, float), np.asarray(goal, float), verdict.obstacle_point(start), things)
