"""The end of the search: rounds of proposals and turns of trees share what time is left."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.proposals import Farthest
from apex_ompl.apex.stages.stage import Solution, Stage, run_stage
from apex_ompl.apex.stages.trees import GrowTrees

TEMPERATURES = (1.6, 2.0, 2.4)
"""Factors on the temperature of proposals in one round after the other: those of the model's own spread have failed."""
ITERATIONS, GROWTH = 20_480, 1.25  # of compiled trees in the first turn, and factor from turn to turn


@dataclass(frozen=True)
class TakeTurns:
    """Turns of RRTConnect, each longer than the one before, and rounds of proposals, until time is up.

    Turns are capped by counts and not by the clock, so that the same seed gives the same path.

    Attributes:
        trees: RRTConnect, or None for rounds alone.
        rounds: Stages of one round after the other, and again from the first; none for trees alone.
    """

    trees: GrowTrees | None
    rounds: tuple[tuple[Stage, ...], ...]

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first valid path, or else the one set aside that is farthest from obstacles, or None."""
        for turn in count() if self.trees is not None or self.rounds else ():
            if context.stop():
                break
            found = None if self.trees is None else self.trees.run(context, round(ITERATIONS * GROWTH**turn))
            if found is not None:
                return found
            found = self._round(context, self.rounds[turn % len(self.rounds)]) if self.rounds else None
            if found is not None:
                return found
        return Farthest().run(context)

    @staticmethod
    def _round(context: SolveContext, stages: tuple[Stage, ...]) -> Solution | None:
        context.pool = context.new_pool()
        for stage in stages:
            if context.stop():
                return None
            found = run_stage(stage, context)
            if found is not None:
                return found
        return None
