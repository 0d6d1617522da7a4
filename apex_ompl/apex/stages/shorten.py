"""Shortening of the best path: shortcuts on a polyline, then the optimiser on a spline."""

from __future__ import annotations

from dataclasses import dataclass

from ompl import geometric as og

from apex_ompl.apex.context import SolveContext
from apex_ompl.kernel.shortcuts import shortcut
from apex_ompl.ompl_adapter.simplify import simplify
from apex_ompl.trajopt.path import Path
from apex_ompl.types import Array

DRAWS = 100  # shortcuts that are tried
RESOLUTION = 0.01  # of the states along them [rad, max-norm]


@dataclass(frozen=True)
class Shorten:
    """Shorten the best path; a polyline is cut short, and fitted by a spline, before it is optimised."""

    def run(self, context: SolveContext) -> None:
        """Accept what is shorter."""
        if context.best is None or context.stop():
            return
        control = context.best.control
        self._optimize(context, self._simplified(context, context.best) if control is None else control)

    @staticmethod
    def _simplified(context: SolveContext, path: Path) -> Array:
        """Return control points of the simplified path, which is accepted where it is valid and shorter."""
        with context.report.timed("simplify"):
            if context.validator.exclusive:
                states, looked = shortcut(context.kernel, path.states, DRAWS, RESOLUTION, context.rng.spawn(1)[0])
                context.note_search(looked)
            else:  # one attempt at a time: foreign checkers may be slow
                states = simplify(og.PathSimplifier(context.si), context.si, path.states, context.stop, 1)
            short = Path(states)
            if short.length < path.length and context.is_valid(states):
                context.accept(short)
        return context.fit(states)

    @staticmethod
    def _optimize(context: SolveContext, control: Array) -> None:
        if context.stop():
            return
        with context.report.timed("polish"):
            better = context.optimizer.shorten(context.kernel, control, context.is_valid, context.stop)
        if better is not None:
            context.accept_if_shorter(better)
