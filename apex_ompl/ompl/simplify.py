"""Shortening of a path by counts, never by the clock, so that the same seed gives the same path."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.ompl.space import array_to_path, path_to_array
from apex_ompl.ompl.validity import MotionValidator, forwarding, motions_until
from apex_ompl.paths.path import path_length
from apex_ompl.types import Array

ROUNDS = 6
MIN_GAIN = 0.01  # a round that shortens by less than this share is the last


def simplify(si: ob.SpaceInformation, path: Array, stop: Callable[[], bool] = lambda: False) -> Array:
    """Return a shorter path with the same ends, by OMPL's vertex reduction and partial shortcuts.

    Motions are checked by the motion validator of ``si``.

    Args:
        si: OMPL's space information of the problem.
        path: States, shape (N, dof).
        stop: Asked whether to end before every round, and before every motion that is checked.
    """
    if len(path) < 3:
        return path
    validator = si.getMotionValidator()
    watched = si if isinstance(validator, MotionValidator) else forwarding(si, stop=stop)
    simplifier, work, best = og.PathSimplifier(watched), array_to_path(watched, path), path
    with motions_until(validator, stop) if isinstance(validator, MotionValidator) else nullcontext():
        for _ in range(ROUNDS):
            if stop():
                break
            simplifier.reduceVertices(work)
            simplifier.partialShortcutPath(work)
            states = path_to_array(work, path.shape[1])
            gain = 1.0 - path_length(states) / max(path_length(best), 1e-12)
            if gain > 0.0:
                best = states
            if gain < MIN_GAIN:
                break
    return np.concatenate([path[:1], best[1:-1], path[-1:]])
