"""Covers of boxes, flat cylinders and closed meshes made in milliseconds, for shapes without one made offline."""

from __future__ import annotations

import coal
import numpy as np

from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.cover.boxes import bounding_boxes
from apex_ompl.collision.cover.proof import PAD, Cover
from apex_ompl.types import Array

COLUMNS = 6  # columns of boxes along each axis of a mesh
LEAVES = 64  # most leaves of a box ...
LEAVES_IN_MESH = 200  # ... and of a mesh


def rough_cover(geometry: coal.CollisionGeometry) -> Cover:
    """Return a cover of a box, a cylinder or the solid of a mesh: balls around boxes that are halved recursively.

    The boxes of a mesh are those of :func:`apex_ompl.collision.cover.boxes.bounding_boxes`, which contain the solid;
    boxes beside a cylinder are left out. No proof is needed, as a ball around all corners of a box contains the box.
    """
    disc, kind = np.inf, geometry.getNodeType()
    if kind == coal.GEOM_BOX:
        boxes, most = np.array([[-geometry.halfSide, geometry.halfSide]]), LEAVES
    elif kind == coal.GEOM_CYLINDER:
        disc, most = float(geometry.radius), LEAVES
        corner = np.array([disc, disc, geometry.halfLength])
        boxes = np.array([[-corner, corner]])
    else:
        boxes, most = bounding_boxes(EnclosingMesh.of(geometry).boundary, COLUMNS), LEAVES_IN_MESH
    sides = boxes[:, 1] - boxes[:, 0]
    longest = float(sides.max())
    while len(boxes) < most and _leaves(sides, longest / 1.1) <= most:
        longest /= 1.1
    queue = [np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])]
    first, count, at = [], [], 0
    while at < len(queue):
        parts = list(boxes) if at == 0 and len(boxes) > 1 else _halves(queue[at], longest)
        parts = [box for box in parts if np.linalg.norm(np.clip(0.0, box[0, :2], box[1, :2])) <= disc]
        first.append(len(queue) if parts else 0)
        count.append(len(parts))
        queue += parts
        at += 1
    nodes = np.array(queue)
    radii = np.linalg.norm(nodes[:, 1] - nodes[:, 0], axis=1) / 2.0 + PAD
    return Cover(nodes.mean(axis=1), radii, np.array(first, np.int64), np.array(count, np.int64))


def _leaves(sides: Array, longest: float) -> float:
    """Return the number of boxes after halving sides, shape (boxes, 3), until none is longer than ``longest``."""
    return float(np.prod(2.0 ** np.ceil(np.log2(np.maximum(sides / longest, 1.0))), axis=1).sum())


def _halves(box: Array, longest: float) -> list[Array]:
    """Return the halves of a box across its longest side, shape (2, 3) each; none when the side is short enough."""
    sides = box[1] - box[0]
    axis = int(np.argmax(sides))
    if sides[axis] <= longest:
        return []
    middle = (box[0, axis] + box[1, axis]) / 2.0
    lower, upper = box.copy(), box.copy()
    lower[1, axis] = upper[0, axis] = middle
    return [lower, upper]
