"""Distances from obstacles of many scenes at once, in terms of NumPy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled import obstacle_batches
from apex_ompl.kernel.compiled.arrays import GRID_ROW, SceneArrays
from apex_ompl.kernel.compiled.layout import pack
from apex_ompl.kernel.threads import in_threads
from apex_ompl.types import Array
from apex_ompl.util.arrays import compact


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
            obstacle_batches.nearest_of_scenes(
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
        obstacle_batches.least_distances(*self._packed, np.ascontiguousarray(owner, np.int64), balls, room, found)
        return found

    def clearances(self, balls: Array, limit: float) -> Array:
        """Return the least distances of groups of balls from each obstacle alone, shape (T, G) [m].

        Args:
            balls: As of :func:`apex_ompl.kernel.point_distances.group_clearances`, shape (G, C, 1 + M, 4) [m].
            limit: Larger clearances are given as this [m].
        """
        groups = compact(balls)
        outer, found = compact(groups[:, :, 0].transpose(1, 2, 0)), np.empty((self._count, len(groups)))
        room = np.empty(groups.shape[1::-1])
        obstacle_batches.clearances_alone(*self._packed, outer, groups, float(limit), room, found)
        return found
