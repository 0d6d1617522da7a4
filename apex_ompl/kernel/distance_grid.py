"""Grids of distances to surfaces and points: lower bounds of the signed distance, whatever the number of triangles.

At the nodes near a surface the distance is exact, elsewhere it is that of a distance transform less its largest error.
Between nodes it is interpolated linearly along each axis. A distance changes by at most the way, so that interpolation
is wrong by at most sum_i w_i |x - x_i| <= sqrt(3) / 2 spacings, by which the values at the nodes are lowered.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from apex_ompl.kernel.compiled.grid_building import (
    FAR,
    lower_bounds,
    mark_crossings,
    negate_inside,
    raster_points,
    raster_triangles,
    split_near,
    transform_lines,
)
from apex_ompl.kernel.compiled.layout import Singles
from apex_ompl.types import Array

MOST_NODES = 6_000_000
MOST_NODES_OF_POINTS = 1_000_000  # which are made anew with every image
FINEST = 0.003  # spacing [m]
PADDING = 2.5  # nodes around the box of what is tabulated
BAND = 1.5  # distance up to which nodes are looked at for each triangle, in spacings
SLACK = math.sqrt(3.0) / 2.0  # largest error of interpolation, and of the nearest node, in spacings
ROUNDING = 1e-6  # [m]
KEPT_NODES = 40_000_000  # of grids that are kept by content


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Lower bounds of a signed distance on a grid.

    Attributes:
        low: Place of the first node, shape (3,) [m].
        spacing: Distance of neighbouring nodes [m].
        values: Lower bounds at the nodes that hold between them too, shape (nx, ny, nz) [m].
        box: Least and largest corner of what is tabulated, shape (2, 3) [m].
        radius: Of the balls around points, 0 for a surface [m].
    """

    low: Array
    spacing: float
    values: Singles
    box: Array
    radius: float = 0.0


_kept: OrderedDict[bytes, DistanceGrid] = OrderedDict()
_lock = threading.Lock()  # of these


def grid_of_triangles(corners: Array, solid: bool) -> DistanceGrid:
    """Return the grid of a surface; grids of the same surface are shared.

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [m].
        solid: Whether points inside have negative distances; the surface must be watertight then.
    """
    corners = np.ascontiguousarray(corners, float)
    return _shared(corners.tobytes() + bytes([solid]), lambda: _of_triangles(corners, solid))


def grid_of_points(points: Array, radius: float) -> DistanceGrid:
    """Return the grid of balls of one radius [m] around points, shape (N, 3) [m]; grids of the same are shared."""
    points = np.ascontiguousarray(points, float)
    return _shared(points.tobytes() + np.float64(radius).tobytes(), lambda: _of_points(points, radius))


def _shared(content: bytes, make: Callable[[], DistanceGrid]) -> DistanceGrid:
    """Return the grid of some content; those that were used last are kept."""
    key = hashlib.sha256(content).digest()
    with _lock:
        if key not in _kept:
            _kept[key] = make()
        _kept.move_to_end(key)
        while len(_kept) > 1 and sum(grid.values.size for grid in _kept.values()) > KEPT_NODES:
            _kept.popitem(last=False)
        return _kept[key]


def _of_triangles(corners: Array, solid: bool) -> DistanceGrid:
    box = np.stack([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])
    low, spacing, shape = _lattice(box, 0.0, MOST_NODES)
    scaled = (corners - low) / spacing
    squared = np.full(shape, FAR, np.float32)
    raster_triangles(scaled, BAND, squared)
    values = _bounds(squared, BAND, spacing, ROUNDING)
    if solid:
        turns = np.zeros(shape, np.float32)
        mark_crossings(scaled, turns)
        negate_inside(turns, values, BAND, SLACK, spacing, ROUNDING)
    return DistanceGrid(low, spacing, values, box)


def _of_points(points: Array, radius: float) -> DistanceGrid:
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    low, spacing, shape = _lattice(box, radius, MOST_NODES_OF_POINTS)
    squared = np.full(shape, FAR, np.float32)
    raster_points((points - low) / spacing, squared)
    values = _bounds(squared, 1.0, spacing, radius + ROUNDING)
    return DistanceGrid(low, spacing, values, box + [[-radius], [radius]], radius)


def _lattice(box: Array, radius: float, most: int) -> tuple[Array, float, tuple[int, int, int]]:
    """Return the first node, the spacing and at most so many nodes along the axes of a box, shape (2, 3) [m]."""
    sides = box[1] - box[0] + 2.0 * radius
    spacing = FINEST
    while True:
        shape = np.ceil(sides / spacing + 2.0 * PADDING).astype(int) + 1
        if math.prod(shape.tolist()) <= most:
            break
        spacing *= 1.05
    middle = box.mean(axis=0)
    nx, ny, nz = shape.tolist()
    return middle - spacing * (shape - 1) / 2.0, spacing, (nx, ny, nz)


def _bounds(squared: Singles, band: float, spacing: float, less: float) -> Singles:
    """Return lower bounds from squared distances that are exact up to ``band`` [spacings], less a length [m]."""
    near = np.empty_like(squared)
    # The node nearest to the closest point of the surface is within the slack of it.
    split_near(squared, band, SLACK**2 + 1e-3, near)
    longest = max(squared.shape)
    room = np.empty(3 * longest), np.empty(longest, np.int64), np.empty(longest)
    nx, ny, nz = squared.shape  # along one axis after the other (Felzenszwalb and Huttenlocher 2012)
    for lines in ((nx * ny, nz, 1), (nx, ny, nz), (1, nx, ny * nz)):
        transform_lines(squared.reshape(lines), *room)
    lower_bounds(squared, near, band, SLACK, spacing, less)
    return near
