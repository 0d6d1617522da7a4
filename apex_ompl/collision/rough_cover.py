"""A cover of any closed mesh in milliseconds, for meshes that nobody made a better one of."""

from __future__ import annotations

import coal
import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.sphere_proof import PAD, Cover
from apex_ompl.meshes import bounding_boxes, triangles

COLUMNS = 6


def rough_cover(mesh: coal.BVHModelBase) -> Cover:
    """Return a cover of the solid of a mesh: balls around boxes that contain it, and around pieces of each.

    The boxes are those of ``apex_ompl.meshes.bounding_boxes``, so that nothing is left to be proved: a ball around
    all corners of a box contains the box.
    """
    boxes = bounding_boxes(*triangles(mesh), COLUMNS)
    pieces = [_cut(low, high) for low, high in boxes]
    roots = [_ball(low, high) for low, high in boxes]
    leaves = [_ball(low, high) for rows in pieces for low, high in rows]
    whole = _ball(boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0))
    lone = [len(rows) == 1 for rows in pieces]
    first, count, kept = [1], [len(roots)], []
    at, row = 1 + len(roots), 0
    for rows, single in zip(pieces, lone, strict=True):
        first.append(0 if single else at)
        count.append(0 if single else len(rows))
        if not single:
            kept += leaves[row : row + len(rows)]
            at += len(rows)
        row += len(rows)
    balls = np.array([whole, *roots, *kept])
    first += [0] * len(kept)
    count += [0] * len(kept)
    return Cover(balls[:, :3].copy(), balls[:, 3] + PAD, np.array(first, np.int64), np.array(count, np.int64))


def _ball(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([*(low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0])


def _cut(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pieces of a box, cut along its longest side, about as long as it is wide, shape (pieces, 2, 3)."""
    sides = high - low
    axis = int(np.argmax(sides))
    across = max(float(np.delete(sides, axis).max()), 1e-9)
    ends = np.linspace(low[axis], high[axis], max(1, round(float(sides[axis]) / across)) + 1)
    pieces = np.tile(np.stack([low, high]), (len(ends) - 1, 1, 1))
    pieces[:, 0, axis], pieces[:, 1, axis] = ends[:-1], ends[1:]
    return pieces
