"""Error terms of alignments and poses: angles and tolerances."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from apex_ompl.types import Array

UP = np.array([0.0, 0.0, 1.0])
"""Upward direction of the world."""


def angle(a: Array, b: Array) -> float:
    """Return the angle between two vectors, atan2(|a x b|, a . b) [rad], accurate for nearly parallel vectors too."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def within(errors: Mapping[str, float], bounds: Mapping[str, float]) -> bool:
    """Whether every error is at most its bound, up to rounding."""
    return all(value <= bounds[name] + 1e-12 for name, value in errors.items())


def lowest_direction(axis: Array) -> Array:
    """Return the lowest unit vector orthogonal to a unit axis, shape (3,); down itself for a vertical axis."""
    down = -UP + (UP @ axis) * axis
    length = float(np.linalg.norm(down))
    return down / length if length > 1e-9 else -UP
