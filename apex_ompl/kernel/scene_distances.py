"""Distances of points and balls from the obstacles of one scene or of many, in terms of NumPy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.kernel.compiled.arrays import GRID_ROW, SceneArrays
from apex_ompl.kernel.compiled.geometry import scene_distance
from apex_ompl.kernel.compiled.layout import Integers, pack
from apex_ompl.kernel.tables import SceneTables
from apex_ompl.types import Array, Flags
from apex_ompl.util.arrays import compact
from apex_ompl.util.process import in_threads
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
    scene_distance.nearest_points(*scene.packed, _counted(scene, seen), rows, float(limit), distances, gradients)
    return distances, gradients


def group_clearances(scene: SceneTables, balls: ArrayLike, limit: float = np.inf, seen: Flags | None = None) -> Array:
    """Return the least signed distance of the balls of each group from the obstacles, shape (G,) [m].

    Args:
        scene: The obstacles.
        balls: Centers and radii, shape (G, C, 1 + M, 4) [m]: C clusters of a group with M balls each, after a ball
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
    scene_distance.group_clearances(
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


class ObstacleBatch:
    """Boxes, balls, cylinders and capsules of many scenes, each alone or together with the others of its scene."""

    def __init__(self, kind: NDArray[np.int64], position: Array, rotation: Array, size: Array) -> None:
        """Take T primitives.

        Args:
            kind: Kinds as in :class:`apex_ompl.kernel.compiled.arrays.SceneArrays`, shape (T,).
            position: Shape (T, 3) [m].
            rotation: Rotation matrices, shape (T, 3, 3).
            size: Half edges, or radius and half length along z, shape (T, 3) [m].
        """
        none, nowhere = np.empty(0, np.int64), np.empty((0, 3))
        self._count = len(kind)
        arrays = SceneArrays(
            kind=np.ascontiguousarray(kind, np.int64), owner=none, exact=none, tree_skip=none,
            tree_range=np.empty((0, 2), np.int64), open=none, allowed=np.empty((0, 2), np.int64),
            rotation=compact(rotation), offset=compact(position), size=compact(size), tree_low=nowhere,
            tree_high=nowhere, grid=np.empty((0, GRID_ROW), np.int64), values=np.empty(0, np.float32),
        )  # fmt: skip
        self._packed = pack(arrays)

    def nearest(
        self, first: NDArray[np.int64], points: Array, limit: float, threads: int = 1
    ) -> tuple[Array, Array]:  # fmt: skip
        """Return the signed distances of points from the nearest obstacles of their scenes, and their gradients.

        Args:
            first: First obstacle of each scene, and T, shape (B + 1,).
            points: Points of each scene, shape (B, N, 3) [m].
            limit: Larger distances are given as this, with gradients of 0 [m].
            threads: Number of threads.

        Returns:
            Shapes (B, N) [m] and (B, N, 3).
        """
        distances, gradients = np.empty(points.shape[:2]), np.empty(points.shape)
        starts, rows = np.ascontiguousarray(first, np.int64), compact(points)

        def measure(some: slice) -> None:
            scene_distance.nearest_of_scenes(
                *self._packed, starts[some.start or 0 :], rows[some], float(limit), distances[some], gradients[some]
            )

        in_threads(len(rows), threads, measure)
        return distances, gradients

    def least(self, owner: NDArray[np.int64], centers: Array, radii: Array) -> Array:
        """Return the least distance of each obstacle from balls of its scene, shape (T,) [m].

        Args:
            owner: The scene of each, shape (T,).
            centers: Centers of balls of each scene, shape (B, N, 3) [m].
            radii: Shape (N,) [m].
        """
        balls = np.empty((len(centers), 4, len(radii)))
        balls[:, :3], balls[:, 3] = np.asarray(centers).transpose(0, 2, 1), radii
        found, room = np.empty(len(owner)), np.empty(len(radii))
        scene_distance.least_distances(*self._packed, np.ascontiguousarray(owner, np.int64), balls, room, found)
        return found

    def clearances(self, balls: Array, limit: float) -> Array:
        """Return the least distances of groups of balls from each obstacle alone, shape (T, G) [m].

        Args:
            balls: As of :func:`group_clearances`, shape (G, C, 1 + M, 4) [m].
            limit: Larger clearances are given as this [m].
        """
        groups = compact(balls)
        outer, found = compact(groups[:, :, 0].transpose(1, 2, 0)), np.empty((self._count, len(groups)))
        room = np.empty(groups.shape[1::-1])
        scene_distance.clearances_alone(*self._packed, outer, groups, float(limit), room, found)
        return found
