"""Tabulation of whole grids of distances, each by one call that needs no lock of the interpreter."""

from __future__ import annotations

from apex_ompl.kernel.compiled.compilation import entry_point, inlined
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
from apex_ompl.kernel.compiled.layout import Floats, Integers, Singles


@inlined
def _fill(values: Singles, value: float) -> None:
    """Set all numbers of an array of three axes."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                values[i, j, k] = value


@inlined
def _bounds(
    squared: Singles, near: Singles, band: float, seed: float, slack: float, spacing: float, less: float,
    line: Floats, at: Integers, ends: Floats,
) -> None:  # fmt: skip
    """Put lower bounds into ``near`` from squared distances that are exact up to ``band``; see :func:`lower_bounds`."""
    split_near(squared, band, seed, near)
    for axis in (2, 1, 0):  # one axis after the other (Felzenszwalb and Huttenlocher 2012)
        transform_lines(squared, axis, line, at, ends)
    lower_bounds(squared, near, band, slack, spacing, less)


@entry_point
def tabulate_triangles(
    corners: Floats, solid: bool, band: float, seed: float, slack: float, spacing: float, less: float,
    squared: Singles, values: Singles, line: Floats, at: Integers, ends: Floats,
) -> None:  # fmt: skip
    """Put lower bounds of the distance to triangles into ``values``, negative inside of a solid [m].

    Args:
        corners: Corners of the triangles, shape (T, 3, 3) [spacings].
        solid: Whether they are a closed surface.
        band: Distance up to which distances are exact [spacings].
        seed: Largest squared distance of nodes that others are measured from [spacings].
        slack: What distances to these, and interpolation, are wrong by at most [spacings].
        spacing: Of the nodes [m].
        less: What is subtracted from all [m].
        squared: Room, shape (nx, ny, nz).
        values: Gets the bounds, likewise.
        line: Room, shape (3 n,) for the longest axis.
        at: Room, shape (n,).
        ends: Room, likewise.
    """
    _fill(squared, FAR)
    raster_triangles(corners, band, squared)
    _bounds(squared, values, band, seed, slack, spacing, less, line, at, ends)
    if solid:
        _fill(squared, 0.0)
        mark_crossings(corners, squared)
        negate_inside(squared, values, band, slack, spacing, less)


@entry_point
def tabulate_points(
    points: Floats, seed: float, slack: float, spacing: float, less: float,
    squared: Singles, values: Singles, line: Floats, at: Integers, ends: Floats,
) -> None:  # fmt: skip
    """Put lower bounds of the distance to points, shape (N, 3) [spacings], into ``values`` [m].

    See :func:`tabulate_triangles`; distances are exact up to a spacing.
    """
    _fill(squared, FAR)
    raster_points(points, squared)
    _bounds(squared, values, 1.0, seed, slack, spacing, less, line, at, ends)
