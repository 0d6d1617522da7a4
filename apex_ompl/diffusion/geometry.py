"""Geometry of obstacles on arrays and tensors: rotation matrices, and signed distances of points."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from apex_ompl.datasets.records import SHAPES


def rotation_matrices(orientation: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the rotation matrices, shape (..., 3, 3), of quaternions xyzw of any length, shape (..., 4)."""
    x, y, z, w = np.moveaxis(orientation / np.linalg.norm(orientation, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)), np.float32)


def signed_distances(shape: Tensor, position: Tensor, rotation: Tensor, size: Tensor, points: Tensor) -> Tensor:
    """Return signed distances [m] of points to obstacles, each with points of its own: shape (T, K).

    The formulas are those of the kernel, see :mod:`apex_ompl.kernel.compiled.signed_distance`.

    Args:
        shape: Indices of shapes, shape (T,).
        position: Shape (T, 3) [m].
        rotation: Rotation matrices, shape (T, 3, 3).
        size: Half edges; radius; or radius and half length along z, shape (T, 3) [m].
        points: Shape (T, K, 3) [m].
    """
    local = (points - position[:, None]) @ rotation
    half, kind = size[:, None], shape[:, None]
    excess = local.abs() - half
    box = excess.clamp(min=0.0).norm(dim=-1) + excess.amax(dim=-1).clamp(max=0.0)
    radius, length, from_axis = half[..., 0], half[..., 1], local[..., :2].norm(dim=-1)
    sphere = local.norm(dim=-1) - radius
    across, along = from_axis - radius, local[..., 2].abs() - length
    cylinder = torch.hypot(across.clamp(min=0.0), along.clamp(min=0.0)) + torch.maximum(across, along).clamp(max=0.0)
    capsule = torch.hypot(from_axis, along.clamp(min=0.0)) - radius
    found: Tensor = torch.where(kind == SHAPES.index("box"), box, sphere)
    found = torch.where(kind == SHAPES.index("cylinder"), cylinder, found)
    return torch.where(kind == SHAPES.index("capsule"), capsule, found)
