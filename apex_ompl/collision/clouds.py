"""Point clouds as obstacles: balls of one radius around points.

Coal has no such shape: to it a cloud is the box around it. What touches a cloud is decided by
:mod:`apex_ompl.collision.cloud_contact`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import coal
import numpy as np

from apex_ompl.types import Array
from apex_ompl.util.boxes import bounding_box
from apex_ompl.util.weak_cache import weakly_cached


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
        found: Array = bounding_box(self.points) + np.array([[-self.radius], [self.radius]])
        return found


@weakly_cached
def cloud_of(_: coal.CollisionGeometry) -> PointCloud | None:
    """Return the cloud that a geometry stands for, None for one that is what it is."""
    return None


def cloud_geometry(cloud: PointCloud) -> coal.CollisionGeometry:
    """Return the geometry that stands for a cloud: the box around it."""
    corners = coal.StdVec_Vec3s()
    corners.extend([cloud.box[list(k), [0, 1, 2]] for k in np.ndindex(2, 2, 2)])
    box = coal.Convex.convexHull(corners, True, "Qt")
    cloud_of.keep(box, cloud)
    return box
