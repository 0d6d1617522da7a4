"""Distances of points and balls from the obstacles of a scene, in terms of NumPy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.kernel.compiled import ball_groups, point_distance
from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact
from apex_ompl.util.validation import shape_error


def nearest_points(
    scene: SceneTables, points: ArrayLike, limit: float = np.inf, seen: Flags | None = None
) -> tuple[Array, Array]:
    """Return the signed distances of points from the nearest obstacle, and their gradients.

    Args:
        scene: The obstacles.
        points: Shape (N, 3) [m].
        limit: Larger distances are given as this [m]; a small one is faster.
        seen: Which obstacles of the tables count, shape (obstacles,); all by default.

    Returns:
        Distances, shape (N,) [m], negative inside an obstacle, and gradients, shape (N, 3), 0 where a distance is
        ``limit``. Those from grids are estimates, not bounds.

    Raises:
        ParameterError: Another shape.
    """
    rows = compact(points)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise shape_error(rows, ("N", 3), "points")
    distances, gradients = np.empty(len(rows)), np.empty((len(rows), 3))
    point_distance.nearest_points(*scene.packed, _counted(scene, seen), rows, float(limit), distances, gradients)
    return distances, gradients


def group_clearances(scene: SceneTables, balls: ArrayLike, limit: float = np.inf, seen: Flags | None = None) -> Array:
    """Return the least signed distance of the balls of each group from the obstacles, shape (G,) [m].

    Args:
        scene: The obstacles.
        balls: Centers and radii, shape (G, C, 1 + M, 4) [m]: C clusters of a group with M balls each, behind a ball
            that contains these.
        limit: Larger clearances are given as this [m].
        seen: Which obstacles of the tables count, shape (obstacles,); all by default.

    Raises:
        ParameterError: Another shape.
    """
    groups = compact(balls)
    if groups.ndim != 4 or groups.shape[3] != 4:
        raise shape_error(groups, ("G", "C", "M", 4), "balls")
    outer, clearances = compact(groups[:, :, 0].transpose(1, 2, 0)), np.empty(len(groups))
    ball_groups.group_clearances(
        *scene.packed, _counted(scene, seen), outer, groups, float(limit), np.empty(groups.shape[1::-1]), clearances
    )
    return clearances


def _counted(scene: SceneTables, seen: Flags | None) -> Integers:
    """Return which obstacles count, shape (obstacles,)."""
    count = len(scene.arrays.kind)
    counted = np.ones(count, np.int64) if seen is None else np.ascontiguousarray(seen, np.int64)
    if counted.shape != (count,):
        raise shape_error(counted.astype(float), (count,), "obstacles that count")
    return counted
