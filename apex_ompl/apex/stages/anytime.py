"""Anytime improvement: shorter paths by renoising the best one, or from new proposals, until time is up."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from ompl import base as ob

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.proposals import BATCH, PROPOSED, RESAMPLED
from apex_ompl.model.query import Query
from apex_ompl.paths.candidates import STEPS_PER_PATH, Candidate
from apex_ompl.types import Array

LOG = logging.getLogger("apex_ompl")
VARIATIONS = (0.3, 0.6, None, 0.15)  # noise on the best path, or new proposals, in turn
VARIED = 4  # variations of a path at a time


@dataclass(frozen=True)
class Anytime:
    """Search for shorter paths until time is up or the path length objective is satisfied.

    Attributes:
        asked: Whether to improve paths at all. An objective alone does not ask for it: BIT* and RRT* of OMPL leave one
            in the problem definition that they share with other planners of a ``Benchmark``.
    """

    asked: bool

    def run(self, context: SolveContext) -> None:
        """Accept shorter paths until time is up, or the objective is satisfied."""
        pdef = context.pdef
        objective = pdef.getOptimizationObjective() if pdef.hasOptimizationObjective() else None
        if not self.asked:
            if objective is not None:
                LOG.info("apex: the problem has an optimization objective; it is not optimized without anytime=true")
            return
        if not isinstance(objective, ob.PathLengthOptimizationObjective):
            objective = None
        with context.report.timed("improve"):
            for noise in cycle(VARIATIONS):
                assert context.best is not None
                if context.stop() or (objective is not None and objective.isSatisfied(ob.Cost(context.best.length))):
                    return
                found = self._candidate(context, noise)
                if found is None or context.stop():
                    continue
                better = context.optimizer.shorten(context.kernel, found.control, context.is_valid, context.stop)
                accepted = context.accept_if_shorter(context.spline_path(found.control if better is None else better))
                context.report.improved += accepted

    @staticmethod
    def _candidate(context: SolveContext, noise: float | None) -> Candidate | None:
        """Return a valid candidate near the best path, or from new proposals where ``noise`` is None; or None."""
        assert context.best is not None
        query = _query_of(context, context.best.states)
        control: Array | None
        if noise is None:
            count, origin = BATCH, PROPOSED
            control = context.sampler.propose([query], count)
        else:
            count, origin = VARIED, RESAMPLED
            best = context.fit(context.best.states)
            control = context.sampler.renoise(np.repeat(best[None], count, axis=0), query, noise)
        if control is None:
            return None
        pool = context.new_pool()
        return pool.add(control, origin, context.stop) or pool.improve(STEPS_PER_PATH * count, context.stop)


def _query_of(context: SolveContext, states: Array) -> Query:
    """Return the query that a path, shape (N, dof), answers, or the first one."""
    mine = (q for q in context.queries if np.array_equal(q.start, states[0]) and np.array_equal(q.goal, states[-1]))
    return next(mine, context.queries[0])
