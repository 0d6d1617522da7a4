"""Blocked stretches of a path bridged by short trees: what resampling does not solve, trees may."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.ompl_adapter.space import path_to_array, to_state
from apex_ompl.types import Array

Stop = Callable[[], bool]

CALLS = 4_000  # of the termination condition of one bridge
EVERY = 2  # states of a path that are judged to find its blocked stretches
SPACING = 0.1  # of states on polylines [rad]


def rooted(si: ob.SpaceInformation, pdef: ob.ProblemDefinition, longest: float) -> og.RRTConnect:
    """Return an RRTConnect for a problem, whose longest step is given; 0 lets OMPL choose [rad]."""
    tree = og.RRTConnect(si)
    if longest > 0.0:
        tree.setRange(longest)
    tree.setProblemDefinition(pdef)
    tree.setup()
    return tree


def joined(
    si: ob.SpaceInformation, judge: PathValidator, states: Array, stop: Stop, longest: float = 0.0
) -> Array | None:
    """Return a valid path whose blocked stretches are planned anew by RRTConnect between their free ends, or None.

    Args:
        si: OMPL's space information.
        judge: Decides what is blocked.
        states: The path, shape (N, dof), its ends free.
        stop: Asked often whether to give up.
        longest: Longest step of the trees; 0 lets OMPL choose [rad].
    """
    free = np.array([not stop() and judge.is_free(q) for q in states])
    if stop() or not (free[0] and free[-1]):
        return None
    pieces, k = [states[:1]], 0
    while k < len(states) - 1:
        following = next(j for j in range(k + 1, len(states)) if free[j])
        if following == k + 1 and judge.is_valid(states[[k, following]], stop):
            pieces.append(states[following : following + 1])
        else:
            bridge = _bridge(si, states[k], states[following], stop, longest)
            if bridge is None:
                return None
            pieces.append(bridge[1:])
        k = following
    found = np.concatenate(pieces)
    return found if judge.is_valid(found, stop) else None


def beginning(judge: PathValidator, path: Array, stop: Stop) -> Array:
    """Return the valid beginning of a path, states of shape (M, dof), M >= 1; its start is taken to be valid.

    Checkers that may take their time are asked until ``stop`` holds.
    """
    states = thinned(path)
    for k in range(1, len(states)):
        if (stop() and not judge.alone) or not judge.is_valid(states[k - 1 : k + 1], stop):
            return states[:k]
    return states


def filled(path: Array) -> Array:
    """Return a polyline, shape (N, dof), with states in between, at most ``SPACING`` apart [rad, max-norm]."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, int(np.ceil(np.abs(b - a).max() / SPACING)))
        pieces += [a + (b - a) * (np.arange(1, count)[:, None] / count), b[None]]
    return np.concatenate(pieces)


def thinned(path: Array) -> Array:
    """Return every other state of a path, shape (N, dof), its ends among them."""
    return np.concatenate([path[:-1:EVERY], path[-1:]])


def _bridge(si: ob.SpaceInformation, a: Array, b: Array, stop: Stop, longest: float) -> Array | None:
    """Return a path of RRTConnect's between two free states, or None."""
    pdef = ob.ProblemDefinition(si)
    pdef.setStartAndGoalStates(to_state(si, a), to_state(si, b))
    left = iter(range(CALLS))
    ptc = ob.PlannerTerminationCondition(lambda: stop() or next(left, None) is None)
    if rooted(si, pdef, longest).solve(ptc).getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    inner = path_to_array(pdef.getSolutionPath(), len(a))
    return np.concatenate([a[None], inner[1:-1], b[None]])
