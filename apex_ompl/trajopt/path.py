"""Paths in joint space: polylines, their length, and states at a spacing."""

from __future__ import annotations

import numpy as np

from apex_ompl.types import Array


def path_length(states: Array) -> float:
    """Return the sum of Euclidean joint-space steps of a path, shape (N, dof) [rad]; S_r of the paper."""
    return float(np.linalg.norm(np.diff(states, axis=0), axis=1).sum())


def resample(path: Array, count: int) -> Array:
    """Return ``count`` states evenly spread by length over a path, shape (count, dof), its ends among them."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    wanted = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(wanted, along, column) for column in path.T], axis=1)
