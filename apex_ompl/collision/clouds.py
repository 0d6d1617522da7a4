"""Point clouds as obstacles: balls of one radius around points.

Coal has no such shape: to it a cloud is the box around it. What touches a cloud is decided by
:mod:`apex_ompl.collision.cloud_contact`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import coal
import numpy as np

from apex_ompl.types import Array, Indices
from apex_ompl.util.weak_cache import weakly_cached

CELL = 0.05  # of the index [m]
MOST_CELLS = 2_000_000


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Balls around points.

    Attributes:
        points: Shape (N, 3) [m].
        radius: Radius of the balls [m].
    """

    points: Array
    radius: float

    @cached_property
    def box(self) -> Array:
        """Box around the balls, shape (2, 3) [m]."""
        return np.stack([self.points.min(axis=0) - self.radius, self.points.max(axis=0) + self.radius])

    @cached_property
    def _cells(self) -> tuple[float, Indices, Indices, Array]:
        """Size of the cells, their numbers along each axis, the first point of each cell, and the points by cell."""
        sides = self.box[1] - self.box[0]
        size = max(CELL, float(np.cbrt(np.prod(np.maximum(sides, 1e-9)) / MOST_CELLS)))
        counts = np.maximum(np.ceil(sides / size), 1).astype(np.int64)
        place = np.minimum(((self.points - self.box[0]) / size).astype(np.int64), counts - 1)
        number = np.ravel_multi_index(tuple(place.T), tuple(counts))
        order = np.argsort(number, kind="stable")
        first = np.searchsorted(number[order], np.arange(int(np.prod(counts)) + 1))
        return size, counts, first, self.points[order]

    def inside(self, box: Array) -> Array:
        """Return the points whose balls meet a box, shape (2, 3) [m], and maybe some more; shape (n, 3) [m]."""
        size, counts, first, points = self._cells
        low = np.clip(np.floor((box[0] - self.radius - self.box[0]) / size), 0, counts).astype(int)
        high = np.clip(np.floor((box[1] + self.radius - self.box[0]) / size) + 1, 0, counts).astype(int)
        rows = [
            points[first[(i * counts[1] + j) * counts[2] + low[2]] : first[(i * counts[1] + j) * counts[2] + high[2]]]
            for i in range(low[0], high[0])
            for j in range(low[1], high[1])
            if high[2] > low[2]
        ]
        found = np.concatenate([np.empty((0, 3)), *rows])
        near: Array = found[((found >= box[0] - self.radius) & (found <= box[1] + self.radius)).all(axis=1)]
        return near


@weakly_cached
def cloud_of(_: coal.CollisionGeometry) -> PointCloud | None:
    """Return the cloud that a geometry stands for, None for one that is what it is."""
    return None


def cloud_geometry(cloud: PointCloud) -> coal.CollisionGeometry:
    """Return the geometry that stands for a cloud: the box around it."""
    corners = coal.StdVec_Vec3s()
    corners.extend([cloud.box[list(k), [0, 1, 2]] for k in np.ndindex(2, 2, 2)])
    box = coal.Convex.convexHull(corners, True, "Qt")
    cloud_of.keep(box, cloud)  # type: ignore[attr-defined]
    return box
