"""Grids over paths: where states are judged, and in which order."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array


@lru_cache(maxsize=256)
def bit_reversed(n: int) -> NDArray[np.intp]:
    """Return 0..n-1 in bit-reversed order, shape (n,): each prefix is spread evenly over the range.

    A path that collides somewhere is so rejected after few states (van der Corput's sequence).
    """
    bits = max(n - 1, 1).bit_length()
    numbers = np.arange(1 << bits)
    turned = np.zeros_like(numbers)
    for k in range(bits):
        turned |= ((numbers >> k) & 1) << (bits - 1 - k)
    order = turned[turned < n].astype(np.intp)
    order.flags.writeable = False
    return order


def states_between(a: Array, b: Array, resolution: float) -> Array:
    """Return evenly spaced states strictly between two, at most ``resolution`` apart [rad, max-norm].

    Args:
        a: First state, shape (dof,).
        b: Last state, shape (dof,).
        resolution: Largest spacing, from ``a`` and to ``b`` too.

    Returns:
        States, shape (M, dof); M is 0 when ``a`` and ``b`` are close enough.
    """
    n = max(1, math.ceil(float(np.abs(b - a).max()) / resolution))
    return a + (np.arange(1, n) / n)[:, None] * (b - a)


def sample_path(path: Array, resolution: float) -> tuple[Array, NDArray[np.intp]]:
    """Return states along a polyline at a spacing, and the segment of each.

    Args:
        path: States, shape (N, dof).
        resolution: Largest spacing [rad, max-norm].

    Returns:
        States, shape (M, dof), the given ones among them bit for bit, and segment indices, shape (M,).
    """
    pieces, segments = [path[:1]], [np.zeros(1, np.intp)]
    for k in range(len(path) - 1):
        inner = states_between(path[k], path[k + 1], resolution)
        pieces += [inner, path[k + 1 : k + 2]]
        segments.append(np.full(len(inner) + 1, k, np.intp))
    return np.concatenate(pieces), np.concatenate(segments)
