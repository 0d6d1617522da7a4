"""Queries of the trajectory model: what it is conditioned on; and primitives in place of meshes, points and voxels."""

from __future__ import annotations

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.checker import NO_POINT
from apex_ompl.kernel import Kernel
from apex_ompl.model.primitive_fit import scene_of_primitives
from apex_ompl.model.query import Query
from apex_ompl.types import Array


def make_query(checker: CollisionChecker, start: Array, goal: Array, *, point: bool = True) -> Query:
    """Return the query of going from a state to another, among the obstacles of now.

    Fixtures of the robot are left out. As ``obstacles``, meshes and points are the primitives that they look like.

    Args:
        checker: The robot among obstacles.
        start: Shape (dof,) [rad].
        goal: Shape (dof,) [rad].
        point: Whether the obstacle point is looked for; models that do not see it can do without.
    """
    scene, movable = checker.kernel.scene, checker.movable
    nearest = checker.obstacle_point(start) if point else np.array(NO_POINT)
    ends = np.asarray(start, float), np.asarray(goal, float)
    return Query(*ends, nearest, None, (scene, movable), checker.held_extents)


def rough_kernel(kernel: Kernel) -> Kernel | None:
    """Return the robot among primitives that look like its obstacles; None where these are primitives themselves."""
    scene = scene_of_primitives(kernel.scene)
    return None if scene is None else Kernel(kernel.robot, scene)
