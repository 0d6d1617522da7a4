"""Shortening of the best path: shortcuts on a polyline, then the optimiser on a spline."""

from __future__ import annotations

from dataclasses import dataclass

from ompl import geometric as og

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.trees import compiled_trees, grow
from apex_ompl.kernel.shortcuts import ENOUGH, RESOLUTION, shortcut
from apex_ompl.ompl_adapter.simplify import simplify
from apex_ompl.trajopt.path import Path, path_length
from apex_ompl.types import Array

DETOUR, OTHERS = 1.7, 2  # times the straight line's length, beyond which so many other trees are tried
ITERATIONS = 6_000  # of each of these


@dataclass(frozen=True)
class Shorten:
    """Shorten the best path; a polyline is cut short, and fitted by a spline, before it is optimised.

    A polyline that stays far longer than the straight line goes a long way round: others are looked for by trees.

    Attributes:
        tree_range: Longest step of these trees; 0 lets OMPL choose, None is for no trees [rad].
    """

    tree_range: float | None = None

    def run(self, context: SolveContext) -> None:
        """Accept what is shorter."""
        if context.best is None or context.stop():
            return
        control = context.best.control
        self._optimize(context, self._simplified(context, context.best) if control is None else control)

    def _simplified(self, context: SolveContext, path: Path) -> Array:
        """Return control points of the simplified path, which is accepted where it is valid and shorter."""
        with context.report.timed("simplify"):
            if context.validator.exclusive:
                found = self._cut_short(context, path.states)
            else:  # one attempt at a time: foreign checkers may be slow
                found = [simplify(og.PathSimplifier(context.si), context.si, path.states, context.stop, 1)]
            for states in found:
                short = Path(states)
                if short.length < path.length and context.is_valid(states) and context.accept_if_shorter(short):
                    return context.fit(states)
        return context.fit(found[0])

    def _cut_short(self, context: SolveContext, states: Array) -> list[Array]:
        """Return a polyline, and others in its place where it goes a long way round, cut short; the shortest first."""
        found = [_shortcut(context, states)]
        if self.tree_range is None:
            return found
        for _ in range(OTHERS):
            if context.stop() or path_length(found[0]) <= DETOUR * path_length(states[[0, -1]]):
                break
            other = grow(context, compiled_trees(context, [states[0]], [states[-1]], self.tree_range), ITERATIONS)
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


def _shortcut(context: SolveContext, states: Array) -> Array:
    """Return a polyline cut short."""
    short, looked = shortcut(context.kernel, states, ENOUGH, RESOLUTION, context.rng.spawn(1)[0], context.stop)
    context.note_search(looked)
    return short
