"""Bridges: blocked stretches of the best candidates, planned anew by short trees between their free ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ompl import base as ob

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.apex.stages.stage import Solution
from apex_ompl.apex.trees import compiled_trees, grow, ompl_trees
from apex_ompl.ompl.space import path_to_array
from apex_ompl.paths.path import Path
from apex_ompl.types import Array

MAX_BRIDGED = 2  # candidates
MAX_CALLS = 4_000  # iterations of one bridge
OMPL_BRIDGE_SHARE = 0.25  # of the iterations, for OMPL's trees where compiled ones have found nothing
STRIDE = 2  # of the states of a path that are checked to find its blocked stretches


@dataclass(frozen=True)
class Bridging:
    """Short trees between the free stretches of the best candidates.

    Attributes:
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        calls: Iterations of one bridge, at most.
    """

    tree_range: float
    calls: int = MAX_CALLS

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first candidate whose blocked stretches are bridged, or None."""
        for candidate in sorted(context.pool.candidates, key=lambda one: one.clearance_cost)[:MAX_BRIDGED]:
            if context.stop():
                return None
            with context.report.timed("bridge"):
                states = every_other(context.spline_path(candidate.control).states)
                found = bridge_blocked(context, states, self.tree_range, calls=self.calls)
            if found is not None:
                return Solution(Path(found), "apex+bridge")
        return None


@dataclass(frozen=True)
class NearestToGoal:
    """Note the valid prefix of the best candidates that ends nearest to a goal."""

    def run(self, context: SolveContext) -> Solution | None:
        """Set ``context.nearest``; return None, since an approximate path solves nothing."""
        with context.report.timed("approximate"):
            for candidate in sorted(context.pool.candidates, key=lambda one: one.clearance_cost)[:MAX_BRIDGED]:
                states = valid_prefix(context.validator, context.spline_path(candidate.control).states, context.stop)
                distance = min(float(np.linalg.norm(goal - states[-1])) for goal in context.goals)
                if len(states) > 1 and (context.nearest is None or distance < context.nearest[1]):
                    context.nearest = Path(states), distance
        return None


def bridge_blocked(
    context: SolveContext, states: Array, tree_range: float, *, calls: int = MAX_CALLS
) -> Array | None:  # fmt: skip
    """Return a valid path whose blocked stretches are planned anew by RRT-Connect, or None.

    Args:
        context: Shared by the stages.
        states: Path with free ends, shape (N, dof).
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        calls: Iterations of one bridge, at most.
    """
    validator, stop = context.validator, context.stop
    free = np.array([not stop() and validator.is_free(q) for q in states])
    if stop() or not (free[0] and free[-1]):
        return None
    pieces, k = [states[:1]], 0
    while k < len(states) - 1:
        following = next(j for j in range(k + 1, len(states)) if free[j])
        if following == k + 1 and validator.is_valid(states[[k, following]], stop):
            pieces.append(states[following : following + 1])
        else:
            bridge = _bridge(context, states[k], states[following], tree_range, calls)
            if bridge is None:
                return None
            pieces.append(bridge[1:])
        k = following
    found = np.concatenate(pieces)
    return found if validator.is_valid(found, stop) else None


def valid_prefix(validator: PathValidator, states: Array, stop: Callable[[], bool]) -> Array:
    """Return the valid prefix of a path, shape (M, dof), M >= 1; its start is assumed valid.

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


def _bridge(context: SolveContext, a: Array, b: Array, tree_range: float, calls: int) -> Array | None:
    """Return a path of RRT-Connect between two free states, or None."""
    if context.validator.exclusive:
        found = grow(context, compiled_trees(context, [a], [b], tree_range), calls)
        if found is not None:
            return found
        calls = round(OMPL_BRIDGE_SHARE * calls)
    tree, pdef = ompl_trees(context.validator.si, [a], b, tree_range)
    if tree.solve(context.counted(calls)).getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    inner = path_to_array(pdef.getSolutionPath(), len(a))
    return np.concatenate([a[None], inner[1:-1], b[None]])
