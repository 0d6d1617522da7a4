"""Shortening of the best path: shortcuts on a polyline, then the optimizer on a spline; and anytime improvement.

The latter renoises the best path, or makes new proposals, until time is up.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from itertools import cycle

import numpy as np
from ompl import base as ob

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.proposals import BATCH, PROPOSED, RESAMPLED
from apex_ompl.apex.stages.trees import OMPL_SHARE, compiled_trees, grow, ompl_trees
from apex_ompl.kernel.search import ENOUGH, RESOLUTION, shortcut
from apex_ompl.model.query import Query
from apex_ompl.ompl.repair import simplify
from apex_ompl.ompl.space import path_to_array
from apex_ompl.paths.candidates import STEPS_PER_PATH, Candidate
from apex_ompl.paths.path import Path, path_length
from apex_ompl.types import Array

DETOUR, OTHERS = 1.7, 2  # times the straight line's length, beyond which so many other trees are tried
ITERATIONS = 6_000  # of each of these
MOTIONS = 500  # that are checked to cut a polyline short where spheres do not decide
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
                short = context.weighed(Path(states))
                if short.length < path.length and context.is_valid(states) and context.accept_if_shorter(short):
                    return context.fit(states)
        return context.fit(found[0])

    def _cut_short(self, context: SolveContext, states: Array) -> list[Array]:
        """Return a polyline after shortcuts, and others where it takes a detour; the shortest first."""
        found, weights = [_shortcut(context, states)], context.kernel.robot.arrays.weight
        slow = context.validator.exclusive and not context.validator.by_spheres  # trees are checked by meshes
        if self.tree_range is None or slow:
            return found
        for _ in range(OTHERS):
            if context.stop() or path_length(found[0], weights) <= DETOUR * path_length(states[[0, -1]], weights):
                break
            other = _another(context, states, self.tree_range)
            found += [] if other is None else [_shortcut(context, other)]
            found.sort(key=lambda path: path_length(path, weights))
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
    if context.validator.by_spheres:
        trees = compiled_trees(context, [states[0]], [states[-1]], tree_range)
        return grow(context, trees, ITERATIONS)
    tree, pdef = ompl_trees(context.validator.si, [states[0]], states[-1], tree_range)
    status = tree.solve(context.counted(math.ceil(OMPL_SHARE * ITERATIONS))).getStatus()
    exact = status == ob.PlannerStatus.EXACT_SOLUTION
    return path_to_array(pdef.getSolutionPath(), states.shape[1]) if exact else None


def _shortcut(context: SolveContext, states: Array) -> Array:
    """Return a polyline cut short."""
    if not context.validator.by_spheres:
        left = iter(range(MOTIONS))
        return simplify(context.validator.si, states, lambda: context.stop() or next(left, None) is None)
    short, looked = shortcut(context.kernel, states, ENOUGH, RESOLUTION, context.rng.spawn(1)[0], context.stop)
    context.note_search(looked)
    return short


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
