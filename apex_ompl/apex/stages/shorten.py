"""Shortening of the best path: shortcuts on a polyline, then the optimizer on a spline."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ompl import base as ob

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.trees import OMPL_SHARE, compiled_trees, grow, ompl_trees
from apex_ompl.kernel.search import ENOUGH, RESOLUTION, shortcut
from apex_ompl.ompl.simplify import simplify
from apex_ompl.ompl.space import path_to_array
from apex_ompl.paths.path import Path, path_length
from apex_ompl.types import Array

DETOUR, OTHERS = 1.7, 2  # times the straight line's length, beyond which so many other trees are tried
ITERATIONS = 6_000  # of each of these
MOTIONS = 500  # that are checked to cut a polyline short where another checker decides
PASSES, IDLE, MIN_GAIN = 4, 2, 0.02  # over such a path; it ends after IDLE that shorten by less than MIN_GAIN


@dataclass(frozen=True)
class Shorten:
    """Shorten the best path; a polyline is cut short, and fitted by a spline, before it is optimized.

    Where a polyline stays much longer than the straight line, new trees search for a shorter one.
    Where another checker decides, whose obstacles the optimizer does not know, cutting and optimizing take turns.

    Attributes:
        tree_range: Longest step of these trees; 0 lets OMPL choose, None is for no trees [rad].
    """

    tree_range: float | None = None

    def run(self, context: SolveContext) -> None:
        """Accept shorter paths."""
        if context.best is None or context.stop():
            return
        if context.validator.exclusive:
            control = context.best.control
            self._optimize(context, self._simplified(context, context.best) if control is None else control)
            return
        idle = 0
        for _ in range(PASSES):
            before = context.best.length
            self._optimize(context, self._simplified(context, context.best))
            idle += context.best.length > (1.0 - MIN_GAIN) * before
            if context.stop() or idle == IDLE:
                break

    def _simplified(self, context: SolveContext, path: Path) -> Array:
        """Return control points of the simplified path, which is accepted where it is valid and shorter."""
        with context.report.timed("simplify"):
            found = self._cut_short(context, path.states)
            for states in found:
                short = Path(states)
                if short.length < path.length and context.is_valid(states) and context.accept_if_shorter(short):
                    return context.fit(states)
        return context.fit(found[0])

    def _cut_short(self, context: SolveContext, states: Array) -> list[Array]:
        """Return a polyline after shortcuts, and others where it takes a detour; the shortest first."""
        found = [_shortcut(context, states)]
        if self.tree_range is None:
            return found
        for _ in range(OTHERS):
            if context.stop() or path_length(found[0]) <= DETOUR * path_length(states[[0, -1]]):
                break
            other = _another(context, states, self.tree_range)
            found += [] if other is None else [_shortcut(context, other)]
            found.sort(key=path_length)
        return found

    @staticmethod
    def _optimize(context: SolveContext, control: Array) -> None:
        if context.stop():
            return
        with context.report.timed("polish"):
            better = context.optimizer.shorten(context.kernel, control, context.is_valid, context.stop)
        if better is not None:
            context.accept_if_shorter(context.spline_path(better))


def _another(context: SolveContext, states: Array, tree_range: float) -> Array | None:
    """Return another path between the ends of one, shape (N, dof), by new trees, or None."""
    if context.validator.exclusive:
        trees = compiled_trees(context, [states[0]], [states[-1]], tree_range)
        return grow(context, trees, ITERATIONS)
    tree, pdef = ompl_trees(context.validator.si, [states[0]], states[-1], tree_range)
    status = tree.solve(context.counted(math.ceil(OMPL_SHARE * ITERATIONS))).getStatus()
    exact = status == ob.PlannerStatus.EXACT_SOLUTION
    return path_to_array(pdef.getSolutionPath(), states.shape[1]) if exact else None


def _shortcut(context: SolveContext, states: Array) -> Array:
    """Return a polyline cut short."""
    if not context.validator.exclusive:
        left = iter(range(MOTIONS))
        return simplify(context.validator.si, states, lambda: context.stop() or next(left, None) is None)
    short, looked = shortcut(context.kernel, states, ENOUGH, RESOLUTION, context.rng.spawn(1)[0], context.stop)
    context.note_search(looked)
    return short
