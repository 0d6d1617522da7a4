"""Extents of held objects, whatever their shape."""

from __future__ import annotations

from itertools import product

import coal
import numpy as np

from apex_ompl.collision.shapes import coal_geometry
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.types import Array


def held_extent(held: AttachedObject) -> Array:
    """Return the least and the largest corner of a box around a held object, shape (2, 3) [m].

    The box lies along the axes of the link that holds the object.

    Raises:
        MissingFileError, FileFormatError: Its mesh cannot be read.
    """
    return extent_in_link(coal_geometry(held), held.pose)


def extent_in_link(geometry: coal.CollisionGeometry, pose: Array) -> Array:
    """Return :func:`held_extent` of a geometry at a pose in its link's frame, shape (4, 4) [m]."""
    geometry.computeLocalAABB()
    low, high = geometry.aabb_local.min_, geometry.aabb_local.max_
    corners = np.array(list(product(*zip(low, high, strict=True))))
    placed = corners @ pose[:3, :3].T + pose[:3, 3]
    return np.stack([placed.min(axis=0), placed.max(axis=0)])
