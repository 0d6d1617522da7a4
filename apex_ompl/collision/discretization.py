"""Discretization of paths: the states that are checked along them, and in which order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.kernel.kernel import MOST_STEPS
from apex_ompl.paths.path import states_between
from apex_ompl.types import Array


@dataclass(frozen=True)
class Collision:
    """A collision along a path.

    Attributes:
        state: A colliding state, shape (dof,).
        segment: The state lies between states ``segment`` and ``segment + 1`` of the path.
    """

    state: Array
    segment: int


@lru_cache(maxsize=256)
def bit_reversed(n: int) -> NDArray[np.intp]:
    """Return 0..n-1 in bit-reversed order, shape (n,).

    Each prefix of this van der Corput sequence is spread evenly over the range, so that a path that collides is
    rejected after few states.
    """
    bits = max(n - 1, 1).bit_length()
    numbers = np.arange(1 << bits)
    turned = np.zeros_like(numbers)
    for k in range(bits):
        turned |= ((numbers >> k) & 1) << (bits - 1 - k)
    order = turned[turned < n].astype(np.intp)
    order.flags.writeable = False
    return order


def sample_path(path: Array, resolution: float) -> tuple[Array, NDArray[np.intp]]:
    """Return states along a polyline, at most ``resolution`` apart, and the segment of each.

    Args:
        path: States, shape (N, dof).
        resolution: Largest spacing [rad, max-norm].

    Returns:
        States, shape (M, dof), which include the given ones bit for bit, and segment indices, shape (M,).
    """
    pieces, segments = [path[:1]], [np.zeros(1, np.intp)]
    for k in range(len(path) - 1):
        inner = states_between(path[k], path[k + 1], resolution)
        pieces += [inner, path[k + 1 : k + 2]]
        segments.append(np.full(len(inner) + 1, k, np.intp))
    return np.concatenate(pieces), np.concatenate(segments)


def first_colliding_sample(
    path: Array, resolution: float, start: bool, is_free: Callable[[Array], bool]
) -> Collision | None:
    """Return a colliding state among those of :func:`sample_path`, or None when all are free.

    A given state that is not finite counts as colliding.

    Args:
        path: States, shape (N, dof).
        resolution: Largest spacing [rad, max-norm].
        start: Whether the first state is checked too.
        is_free: Checks a state, shape (dof,). The last state is checked first, then the others in bit-reversed order.

    Raises:
        ParameterError: The path has more than ``MOST_STEPS`` steps.
    """
    broken = ~np.isfinite(path).all(axis=1)
    if broken.any():
        k = int(np.argmax(broken))
        return Collision(path[k].copy(), max(k - 1, 0))
    if float(np.abs(np.diff(path, axis=0)).max(axis=1).sum()) / resolution > MOST_STEPS:
        raise ParameterError("path", f"longer than {MOST_STEPS} steps of {resolution:g}", "a shorter one")
    states, segments = sample_path(path, resolution)
    skip = 0 if start else 1
    last = len(states) - 1 - skip
    for k in (last, *bit_reversed(last)):
        if not is_free(states[k + skip]):
            return Collision(states[k + skip], int(segments[k + skip]))
    return None
