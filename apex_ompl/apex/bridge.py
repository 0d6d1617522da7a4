"""Blocked stretches of a path, planned anew by short trees between their free ends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex.context import stop_after
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.ompl_adapter.space import path_to_array, to_state
from apex_ompl.types import Array

Stop = Callable[[], bool]

MAX_CALLS = 4_000  # of the termination condition of one bridge
STRIDE = 2  # of the states of a path that are checked to find its blocked stretches


def make_tree(si: ob.SpaceInformation, pdef: ob.ProblemDefinition, tree_range: float) -> og.RRTConnect:
    """Return RRTConnect for a problem definition; a range of 0 lets OMPL choose the longest step [rad]."""
    tree = og.RRTConnect(si)
    if tree_range > 0.0:
        tree.setRange(tree_range)
    tree.setProblemDefinition(pdef)
    tree.setup()
    return tree


def bridge_blocked(
    si: ob.SpaceInformation, validator: PathValidator, states: Array, stop: Stop, tree_range: float = 0.0,
    *, calls: int = MAX_CALLS,
) -> Array | None:  # fmt: skip
    """Return a valid path whose blocked stretches are planned anew by RRTConnect, or None.

    Args:
        si: OMPL's space information.
        validator: Decides what is blocked.
        states: Path with free ends, shape (N, dof).
        stop: Asked often whether to give up.
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        calls: Of the termination condition of one bridge, at most.
    """
    free = np.array([not stop() and validator.is_free(q) for q in states])
    if stop() or not (free[0] and free[-1]):
        return None
    pieces, k = [states[:1]], 0
    while k < len(states) - 1:
        following = next(j for j in range(k + 1, len(states)) if free[j])
        if following == k + 1 and validator.is_valid(states[[k, following]], stop):
            pieces.append(states[following : following + 1])
        else:
            bridge = _bridge(si, states[k], states[following], stop_after(calls, stop), tree_range)
            if bridge is None:
                return None
            pieces.append(bridge[1:])
        k = following
    found = np.concatenate(pieces)
    return found if validator.is_valid(found, stop) else None


def valid_prefix(validator: PathValidator, states: Array, stop: Stop) -> Array:
    """Return the valid beginning of a path, shape (M, dof), M >= 1; its start is taken to be valid.

    Foreign checkers, which may be slow, are asked until ``stop`` holds.
    """
    coarse = every_other(states)
    for k in range(1, len(coarse)):
        if (stop() and not validator.exclusive) or not validator.is_valid(coarse[k - 1 : k + 1], stop):
            return coarse[:k]
    return coarse


def every_other(states: Array) -> Array:
    """Return every other state of a path, shape (N, dof), its ends among them."""
    return np.concatenate([states[:-1:STRIDE], states[-1:]])


def _bridge(
    si: ob.SpaceInformation, a: Array, b: Array, ptc: ob.PlannerTerminationCondition, tree_range: float
) -> Array | None:
    """Return RRTConnect's path between two free states, or None."""
    pdef = ob.ProblemDefinition(si)
    pdef.setStartAndGoalStates(to_state(si, a), to_state(si, b))
    status = make_tree(si, pdef, tree_range).solve(ptc).getStatus()
    if status != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    inner = path_to_array(pdef.getSolutionPath(), len(a))
    return np.concatenate([a[None], inner[1:-1], b[None]])
