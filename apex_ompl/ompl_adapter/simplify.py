"""Shortening of a path by counts, never by the clock, so that the same seed gives the same path."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.ompl_adapter.space import array_to_path, path_to_array
from apex_ompl.trajopt.path import path_length

ROUNDS, MOST_ROUNDS = 6, 60  # of OMPL's own length, and of given ones
LEAST_GAIN = 0.01  # a round that shortens by less than this share is the last


def simplify(
    simplifier: og.PathSimplifier,
    si: ob.SpaceInformation,
    path: NDArray[np.float64],
    stop: Callable[[], bool] = lambda: False,
    at_once: int = 0,
) -> NDArray[np.float64]:
    """Return a shorter path with the same ends, by OMPL's vertex reduction and partial shortcuts.

    Motions are checked by the motion validator of ``si``.

    Args:
        simplifier: OMPL's simplifier for ``si``.
        si: OMPL's space information of the problem.
        path: States, shape (N, dof).
        stop: Asked before every round whether to end.
        at_once: Attempts to shorten the path in a round; 0 means as many as OMPL takes for its own.
    """
    if len(path) < 3:
        return path
    work = array_to_path(si, path)
    best = path
    for _ in range(ROUNDS if not at_once else MOST_ROUNDS):
        if stop():
            break
        simplifier.reduceVertices(work, at_once)
        simplifier.partialShortcutPath(work, at_once)
        states = path_to_array(work, path.shape[1])
        gain = 1.0 - path_length(states) / max(path_length(best), 1e-12)
        if gain > 0.0:
            best = states
        if gain < LEAST_GAIN and not at_once:
            break
    return np.concatenate([path[:1], best[1:-1], path[-1:]])
