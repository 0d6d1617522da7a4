"""Geometry of obstacles on arrays and tensors: rotation matrices, and signed distances of points."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array

Numbers = Any
"""An array of NumPy or a tensor of torch; functions return the kind that they are given."""

SHAPES = ("box", "sphere", "cylinder", "capsule")
"""Shapes of obstacles. Sizes are edges; radius; or radius and length along z [m]."""

ObstacleRecord = tuple[int, Sequence[float], Sequence[float], Sequence[float]]
"""An obstacle: index of its shape in :data:`SHAPES`, position [m], orientation (xyzw), size [m]."""

HeldExtent = tuple[str, Array]
"""A link that holds an object, and the least and largest corner of a box around it in the link's frame, (2, 3) [m]."""


def rotation_matrices(orientation: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the rotation matrices, shape (..., 3, 3), of quaternions xyzw of any length, shape (..., 4)."""
    x, y, z, w = np.moveaxis(orientation / np.linalg.norm(orientation, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)), np.float32)


def signed_distances(shape: Numbers, position: Numbers, rotation: Numbers, size: Numbers, points: Numbers) -> Numbers:
    """Return signed distances [m] of points to obstacles, each with points of its own: shape (T, K).

    Arguments are all arrays, or all tensors. The formulas are those of the kernel, see
    the kernel's (:mod:`apex_ompl.kernel.scene_distances`).

    Args:
        shape: Indices of shapes, shape (T,).
        position: Shape (T, 3) [m].
        rotation: Rotation matrices, shape (T, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (T, 3) [m].
        points: Shape (T, K, 3) [m].
    """
    xp = array_module(points)
    local = (points - position[:, None]) @ rotation
    half, kind = size[:, None], shape[:, None]
    excess = abs(local) - half
    box = _norm(xp, excess.clip(min=0.0)) + xp.amax(excess, -1).clip(max=0.0)
    radius, length, from_axis = half[..., 0], half[..., 1], _norm(xp, local[..., :2])
    sphere = _norm(xp, local) - radius
    across, along = from_axis - radius, abs(local[..., 2]) - length
    cylinder = xp.hypot(across.clip(min=0.0), along.clip(min=0.0)) + xp.maximum(across, along).clip(max=0.0)
    capsule = xp.hypot(from_axis, along.clip(min=0.0)) - radius
    found = xp.where(kind == SHAPES.index("box"), box, sphere)
    found = xp.where(kind == SHAPES.index("cylinder"), cylinder, found)
    return xp.where(kind == SHAPES.index("capsule"), capsule, found)


def array_module(values: Numbers) -> ModuleType:
    """Return the module whose functions work on an array or tensor: NumPy, or torch."""
    return np if isinstance(values, np.ndarray) else import_module("torch")


def _norm(xp: ModuleType, vectors: Numbers) -> Numbers:
    """Return the norms, shape (...), of vectors, shape (..., n)."""
    return xp.sqrt((vectors * vectors).sum(-1))
