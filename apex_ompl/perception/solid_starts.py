"""Boxes and cylinders from which fits to an obstacle start.

Normals of its points tell how it may be turned, and their extents its size.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import pinocchio as pin

from apex_ompl.perception.library import opencv
from apex_ompl.types import Array

Kind = Literal["box", "cylinder"]

SAME_WAY = np.cos(np.radians(22.0))  # of normals of a plane
SAME_AXIS = np.cos(np.radians(10.0))  # of cylinders
PARALLEL = 1e-8  # squared sine between two directions that count as one
SQUARE = 0.5  # cosine between normals of different sides
THICK = 0.012  # distance from a plane of its points [m]
THIN, THICK_SHARE = 0.35, 0.8  # shares of the width of what may be the depth of a box, and of what surely is
PAIRS = np.random.default_rng(0).random((60, 2))  # of normals whose common perpendicular may be an axis


class Solid(NamedTuple):
    """A solid: its kind, lengths, shape (3,) [m], and pose in the optical frame, shape (4, 4) [m]."""

    kind: Kind
    size: Array
    pose: Array


def resized(solid: Solid, axis: int, length: float, side: float = 0.0) -> Solid:
    """Return a solid with another length along an axis, where the end on a side moves, by default that far away."""
    pose, size = solid.pose.copy(), solid.size.copy()
    moving = side or np.sign(pose[:3, axis] @ pose[:3, 3])
    pose[:3, 3] += moving * (length - size[axis]) / 2.0 * pose[:3, axis]
    size[axis] = length
    if solid.kind == "cylinder" and axis < 2:
        size[:2] = length
    return Solid(solid.kind, size, pose)


def _plane(places: Array, normals: Array) -> Array | None:
    """Return the normal of the plane through the places of the largest group of like normals; None without normals."""
    if not len(normals):
        return None
    alike = normals @ normals.T > SAME_WAY
    group = alike[int(np.argmax(alike @ np.ones(len(normals))))]
    mean = normals[group].mean(axis=0)
    mean /= np.sqrt(mean @ mean)
    for _ in range(2):
        height = places @ mean
        near = group & (np.abs(height - _middle(height[group])) < THICK)
        if np.count_nonzero(near) < 6:
            break
        own = places[near] - places[near].mean(axis=0)
        found = np.linalg.eigh(own.T @ own)[1][:, 0]
        mean = found if found @ mean >= 0.0 else -found
    return np.asarray(mean)


def _round_axis(normals: Array) -> Array | None:
    """Return the axis to which most normals are perpendicular or, those of a cap, parallel (RANSAC); None for few."""
    if len(normals) < 8:
        return None
    pairs = (PAIRS * len(normals)).astype(np.int64)
    axes = crosses(normals[pairs[:, 0]], normals[pairs[:, 1]])
    lengths = np.sqrt((axes * axes).sum(axis=1))
    if not (lengths > 0.3).any():
        return None
    axes = axes[lengths > 0.3] / lengths[lengths > 0.3, None]
    along = np.abs(normals @ axes.T)
    best = int(np.argmax((along < 0.2).sum(axis=0) + (along > 0.95).sum(axis=0)))
    side = normals[along[:, best] < 0.25]
    return np.asarray(np.linalg.eigh(side.T @ side)[1][:, 0])


def starts(extent: Array, places: Array, normals: Array) -> list[Solid]:
    """Return boxes and cylinders from which fits start, in the optical frame.

    Args:
        extent: Points of all pixels, shape (M, 3) [m].
        places: Smoothed points of the surface, shape (K, 3) [m].
        normals: Unit normals there, shape (K, 3).
    """
    first = _plane(places, normals)
    if first is None:
        first = -extent.mean(axis=0)
        first /= np.sqrt(first @ first)
    rest = np.abs(normals @ first) < SQUARE
    enough = np.count_nonzero(rest) > max(3.0, 0.06 * len(normals))
    second = _plane(places[rest], normals[rest]) if enough else None
    frames = [_frame(first, second if second is not None else _longest(extent, first))]
    if second is None:  # one side is seen, or a round one
        frames += [_turned(frames[0], np.pi / 4.0), _squared(extent, first)]
    boxes = [one for frame in frames for one in _boxes(frame, extent)]
    axes = [first] if second is None else [first, second]
    for one in (_round_axis(normals), frames[0][:, 1]):
        if one is not None and all(abs(one @ axis) < SAME_AXIS for axis in axes):
            axes.append(one)
    return boxes + [one for axis in axes for one in _cylinders(axis, extent)]


def _frame(first: Array, second: Array) -> Array:
    """Return a rotation whose x is the first vector and whose y is in the plane of both, if they are not parallel."""
    y = second - (second @ first) * first
    if y @ y < PARALLEL:
        y = _cross(first, np.eye(3)[int(np.argmin(np.abs(first)))])
    y /= np.sqrt(y @ y)
    return np.stack([first, y, _cross(first, y)], axis=1)


def _turned(frame: Array, angle: float) -> Array:
    """Return a rotation turned about its x [rad]."""
    return np.asarray(frame @ pin.exp3(np.array([angle, 0.0, 0.0])))


def _longest(points: Array, normal: Array) -> Array:
    """Return the direction across a normal in which points extend most; any across it for points on a line along it."""
    flat = points - points.mean(axis=0)
    flat = flat - (flat @ normal)[:, None] * normal
    found = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    return np.asarray(_frame(normal, found)[:, 1])


def _squared(points: Array, normal: Array) -> Array:
    """Return the rotation whose x is a normal, along the sides of the smallest rectangle around points across it."""
    y = _longest(points, normal)
    z = _cross(normal, y)
    flat = np.stack([points @ y, points @ z], axis=-1).astype(np.float32)
    angle = np.radians(opencv().minAreaRect(flat)[2])
    return _frame(normal, np.cos(angle) * y + np.sin(angle) * z)


def _boxes(frame: Array, extent: Array) -> list[Solid]:
    """Return a box of the points' extents and, where it is flat, one that is as deep as it is wide."""
    low, high = _extent(extent, frame)
    solid = _solid("box", np.maximum(high - low, 0.01), frame, (high + low) / 2.0)
    share = solid.size[0] / solid.size[1:].mean()
    return ([solid] if share > THIN else []) + ([_deep(solid, 0)] if share < THICK_SHARE else [])


def _middle(values: Array) -> float:
    """Return a median."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _extent(points: Array, frame: Array) -> tuple[Array, Array]:
    """Return the first and the last percentile of points along each axis of a frame."""
    along = np.ascontiguousarray(frame.T @ points.T)
    skipped, last = along.shape[1] // 100, along.shape[1] - 1
    order = np.partition(along, (skipped, last - skipped), axis=1)
    return order[:, skipped], order[:, last - skipped]


def _cross(a: Array, b: Array) -> Array:
    """Return the vector product of two vectors, shape (3,); NumPy's takes ten times as long."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def crosses(a: Array, b: Array) -> Array:
    """Return the vector products of rows, shape (N, 3)."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


def _deep(solid: Solid, axis: int) -> Solid:
    """Return a solid at least as deep along an axis as it is wide across it."""
    others = float(np.delete(solid.size, axis).mean())
    return resized(solid, axis, max(others, float(solid.size[axis])))


def _cylinders(axis: Array, points: Array) -> list[Solid]:
    """Return cylinders along an axis whose outline and front are those of the points."""
    sight = points.mean(axis=0)
    across = _cross(axis, sight)
    seen_end = float(np.abs(axis @ sight) / np.sqrt(sight @ sight))  # cosine
    if across @ across < 0.0004 * (sight @ sight):  # along the line of sight
        across = _longest(points, axis)
    across /= np.sqrt(across @ across)
    frame = np.stack([across, _cross(axis, across), axis], axis=1)
    low, high = _extent(points, frame)
    size, middle = np.maximum(high - low, 0.01), (high + low) / 2.0
    away = frame.T @ sight
    radius = float(size[0]) / 2.0
    if seen_end < 0.8 and size[2] > 0.4 * radius:
        middle[1] = low[1] + radius if away[1] > 0.0 else high[1] - radius
    solid = _solid("cylinder", np.array([2.0 * radius, 2.0 * radius, size[2]]), frame, middle)
    return [_deep(solid, 2) if seen_end > 0.6 else solid]


def _solid(kind: Kind, size: Array, frame: Array, middle: Array) -> Solid:
    pose = np.eye(4)
    pose[:3, :3] = frame if np.linalg.det(frame) > 0.0 else frame * (1.0, 1.0, -1.0)
    pose[:3, 3] = frame @ middle
    return Solid(kind, np.maximum(size, 0.01), pose)
