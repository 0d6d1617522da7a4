"""Sphere covers of a robot's solids and held objects: from the robot's file, or rough ones made in milliseconds.

No proof is needed for a rough cover: each ball contains all corners of a box that contains its part of the solid.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import coal
import numpy as np

from apex_ompl.collision.containment import EnclosingMesh
from apex_ompl.collision.cover.proof import PAD, Cover
from apex_ompl.collision.cover.spheres import make_cover, read_covers, shape_key
from apex_ompl.collision.shapes import is_shell
from apex_ompl.kernel.geometry import column_boxes
from apex_ompl.robot import Robot
from apex_ompl.scene.meshes import is_watertight
from apex_ompl.types import Array
from apex_ompl.util.cache import kept, weakly_cached

BOX_PAD = 1e-6  # margin of boxes, which exceeds rounding errors [m]
COLUMN_PAD = 1e-9  # margin of columns [m]
CYLINDER_LEAVES = 48  # most leaves
GAPS = np.linspace(0.1, 0.8, 29)[:, None, None, None]  # of the ball at an end, as shares of the radius
IN_RING = np.arange(4, 15)[:, None, None]  # balls around an edge
RING_RADII = np.linspace(0.55, 0.98, 16)[:, None]  # of their centers, as shares of the radius
SUNK = np.linspace(0.5, 1.5, 6)  # of their centers below the end, as shares of the height of the ring
COLUMNS = 6  # columns of boxes along each axis of a mesh
BOX_LEAVES = 64  # most leaves of a box ...
MESH_LEAVES = 200  # ... and of a mesh
MOST_KEPT = 1024  # covers made at run time that are kept
QUICK_GAPS, QUICK_LEAVES = (0.02, 0.005), 32  # of covers made at run time


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


class _End(NamedTuple):
    """Balls of one end, with the radius of the cylinder as the unit of length.

    Attributes:
        gap: Gap of the ball at the end.
        in_ring: Number of balls around the edge.
        ring: Radius of the ring of their centers.
        sunk: Distance of these from the end.
        ball: Their radius.
    """

    gap: float
    in_ring: int
    ring: float
    sunk: float
    ball: float


def cylinder_cover(radius: float, half_length: float) -> Cover:
    """Return a cover of a cylinder along z that is at least as long as wide.

    With the radius as the unit of length, a ball of radius 1 + g at depth 1 below each end protrudes by the gap
    g. It contains the disc of radius p = sqrt((1 + g)^2 - 1) at the end, and the whole cross-section at depths from
    1 - p to 1 + p. The ring that is left there, from p to 1 and as deep as 1 - p, is covered by balls around equal
    sectors of it, and the middle by balls around equal lengths. The numbers are those of the least gap.

    Args:
        radius: Radius [m].
        half_length: Half of the length, at least the radius [m].
    """
    end, middle = _choose(half_length / radius)
    reach = math.sqrt((1.0 + end.gap) ** 2 - 1.0)
    angles = 2.0 * np.pi * np.arange(end.in_ring) / end.in_ring
    rim = np.stack([end.ring * np.cos(angles), end.ring * np.sin(angles), np.full(end.in_ring, -end.sunk)], axis=1)
    top = np.concatenate([[[0.0, 0.0, -1.0]], rim]) + [0.0, 0.0, half_length / radius]
    top_radii = np.array([1.0 + end.gap, *[end.ball] * end.in_ring])
    inner = max(0.0, half_length / radius - 1.0 - reach)  # half the length of the middle
    places = inner * ((2.0 * np.arange(middle) + 1.0) / max(middle, 1) - 1.0)
    between = np.stack([np.zeros(middle), np.zeros(middle), places], axis=1)
    between_radii = np.full(middle, math.hypot(1.0, inner / max(middle, 1)))
    parts = [(top, top_radii), (top * [1.0, 1.0, -1.0], top_radii), *([(between, between_radii)] if middle else [])]
    low = inner if middle else 0.0  # the parts of the cylinder that the groups answer for
    spans = [(low, half_length / radius), (-half_length / radius, -low), (-inner, inner)][: len(parts)]
    centers, radii = [np.zeros(3)], [math.hypot(1.0, half_length / radius)]
    for lower, upper in spans:
        centers.append(np.array([0.0, 0.0, (lower + upper) / 2.0]))
        radii.append(math.hypot(1.0, (upper - lower) / 2.0))
    sizes = [len(part) for _, part in parts]
    firsts = 1 + len(parts) + np.cumsum([0, *sizes])[:-1]
    return Cover(
        radius * np.concatenate([np.array(centers), *(part for part, _ in parts)]),
        radius * np.concatenate([radii, *(part for _, part in parts)]) + PAD,
        np.array([1, *firsts, *[0] * sum(sizes)], np.int64),
        np.array([len(parts), *sizes, *[0] * sum(sizes)], np.int64),
    )


def _choose(half_length: float) -> tuple[_End, int]:
    """Return the balls of an end, and the number of balls in the middle, for a cylinder of radius 1."""
    reach = np.sqrt((1.0 + GAPS) ** 2 - 1.0)
    height = 1.0 - reach
    wide = np.maximum(reach, 0.0)
    cosine = np.cos(np.pi / IN_RING)
    corner = np.maximum(
        1.0 + RING_RADII**2 - 2.0 * RING_RADII * cosine, wide**2 + RING_RADII**2 - 2.0 * wide * RING_RADII * cosine
    )
    across: Array = np.maximum(corner, np.maximum((1.0 - RING_RADII) ** 2, (RING_RADII - wide) ** 2))
    deep = SUNK * height
    ball = np.sqrt(across + np.maximum(deep, height - deep) ** 2)
    ring_gap = np.maximum(ball - deep, RING_RADII + ball - 1.0)
    most = np.maximum(CYLINDER_LEAVES - 2 * (IN_RING + 1), 1)
    inner = np.maximum(half_length - 1.0 - reach, 0.0)
    gap = np.maximum(np.maximum(ring_gap, GAPS), np.hypot(1.0, inner / most) - 1.0)
    gap = np.where(height > 0.0, gap, np.inf)
    at = np.unravel_index(int(np.argmin(gap)), gap.shape)
    chosen = [float(np.broadcast_to(x, gap.shape)[at]) for x in (GAPS, IN_RING, RING_RADII, deep, ball, inner, gap)]
    middle = math.ceil(chosen[5] / math.sqrt((1.0 + chosen[6]) ** 2 - 1.0) - 1e-9)
    return _End(chosen[0], int(chosen[1]), *chosen[2:5]), middle


def rough_cover(geometry: coal.CollisionGeometry) -> Cover:
    """Return a cover of a box, a cylinder or the solid of a mesh: balls around boxes that are halved recursively.

    The boxes of a mesh are those of :func:`apex_ompl.collision.cover.quick.bounding_boxes`, which contain the solid;
    boxes beside a cylinder are left out. No proof is needed, as a ball around all corners of a box contains the box.
    """
    disc, kind = np.inf, geometry.getNodeType()
    if kind == coal.GEOM_BOX:
        boxes, most = np.array([[-geometry.halfSide, geometry.halfSide]]), BOX_LEAVES
    elif kind == coal.GEOM_CYLINDER:
        disc, most = float(geometry.radius), BOX_LEAVES
        corner = np.array([disc, disc, geometry.halfLength])
        boxes = np.array([[-corner, corner]])
    else:
        boxes, most = bounding_boxes(EnclosingMesh.of(geometry).boundary, COLUMNS), MESH_LEAVES
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


_quick: dict[str, Cover] = {}  # by shape key


def covers_of(robot: Robot, shapes: Sequence[coal.CollisionGeometry]) -> list[Cover]:
    """Return a cover of each shape: one from the robot's file, or a rough one made now.

    Covers in files are not checked here: ``apex-ompl robot prepare`` writes only proved covers, and the tests prove
    again those that ship.

    Raises:
        MissingFileError: The robot names a file of covers that cannot be read.
        FileFormatError: That file does not follow its schema.
    """
    given = _covers_in_file(robot)
    found = []
    for shape in shapes:
        key = shape_key(shape)
        found.append(given[key] if key in given else kept(_quick, key, partial(_quick_cover, shape), MOST_KEPT))
    return found


@weakly_cached
def _covers_in_file(robot: Robot) -> dict[str, Cover]:
    return read_covers(robot.covers) if robot.covers is not None else {}


def _quick_cover(shape: coal.CollisionGeometry) -> Cover:
    kind = shape.getNodeType()
    if kind == coal.GEOM_CYLINDER and shape.halfLength >= shape.radius:
        return cylinder_cover(float(shape.radius), float(shape.halfLength))
    if is_shell(shape) or kind in (coal.GEOM_BOX, coal.GEOM_CYLINDER):
        return rough_cover(shape)
    return make_cover(shape, QUICK_GAPS, effort=1, most=QUICK_LEAVES)
