"""Boxes that together contain the solid of a triangle mesh."""

from __future__ import annotations

import numpy as np

from apex_ompl.kernel.geometry import column_boxes
from apex_ompl.scene.meshes import is_watertight
from apex_ompl.types import Array

BOX_PAD = 1e-6  # margin of boxes, which exceeds rounding errors [m]
COLUMN_PAD = 1e-9  # margin of columns [m]


def bounding_boxes(corners: Array, columns: int = 8) -> Array:
    """Return boxes whose union contains the solid of a mesh, shape (boxes, 2, 3) [m].

    The mesh is cut into columns along one axis. A line along that axis through a point of the solid leaves the solid
    at both ends through the surface, inside the same column. The box around the part of the surface in a column
    therefore contains the part of the solid in it. The axis with the smallest volume of boxes is chosen. A surface
    that is not watertight gets a single box, as points with a winding number above 1/2 lie in its convex hull.

    Args:
        corners: Corners of the triangles, holes capped (see :func:`apex_ompl.scene.meshes.capped`), shape
            (T, 3, 3) [m].
        columns: Number of columns along each of the two other axes.
    """
    if not is_watertight(corners):
        columns = 1
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    width = np.maximum((high - low) / columns, 1e-12)
    boxes = column_boxes(corners, low, width, COLUMN_PAD, columns)
    found = [along[np.isfinite(along).all(axis=(2, 3))] for along in boxes]
    least = min(found, key=lambda some: float(np.prod(some[:, 1] - some[:, 0], axis=1).sum()))
    wide: Array = least + np.array([-BOX_PAD, BOX_PAD])[:, None]
    return wide
