"""Stages under constraints along the path: lines, trees and proposals, each brought onto the constraints.

They take the place of the others where the state validity checker has constraints. Trees find most paths first; lines
and proposals give shorter ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.stage import Solution
from apex_ompl.paths.path import Path, path_length
from apex_ompl.types import Array

if TYPE_CHECKING:
    from apex_ompl.constraints.paths import ConstrainedPaths

LINE, TREES, PROPOSED = "line+projection", "trees on constraints", "apex+projection"
DRAWS = 40  # of shortcuts along a path of trees
DETOUR = 1.3  # times the straight line's length, beyond which proposals are made for a shorter path


def on_constraints(context: SolveContext) -> ConstrainedPaths:
    """Return what makes paths on the constraints of a context, which has some."""
    assert context.constrained is not None
    return context.constrained


@dataclass(frozen=True)
class ConstrainedLines:
    """The straight lines between starts and goals, optimized under constraints."""

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first that becomes valid, or None."""
        with context.report.timed("known"):
            for start, goal in context.pairs:
                if context.stop():
                    return None
                context.report.candidates += 1
                found = on_constraints(context).repaired(context.optimizer.spline.line(start, goal))
                if found is not None:
                    return Solution(Path(found[1]), LINE)
        return None


@dataclass(frozen=True)
class ConstrainedTrees:
    """RRT-Connect on the constraints, from all starts to all goals; it goes on where it stopped before.

    Attributes:
        iterations: Number of random states.
    """

    iterations: int

    def run(self, context: SolveContext) -> Solution | None:
        """Return the path of the trees, or None where they do not meet, or it is not valid."""
        found = self.search(context)
        if found is None:
            return None
        context.tree_nodes, states = found
        return Solution(Path(states), TREES)

    def search(self, context: SolveContext) -> tuple[Array, Array] | None:
        """Return nodes and states of a valid path, or None where there is none."""
        paths = on_constraints(context)
        with context.report.timed("rrtconnect"):
            trees = context.constrained_trees or paths.trees(
                np.array(context.starts), np.array(context.goals), context.rng.spawn(1)[0]
            )
            context.constrained_trees = trees
            nodes = None if trees is None else trees.grow(self.iterations, context.stop)
            if trees is not None:
                context.note_search(trees.take_counts())
        if nodes is None:
            return None
        context.constrained_trees = None  # they have met: others are to find another path
        with context.report.timed("check"):
            states = paths.along(nodes)
        return None if states is None else (nodes, states)


@dataclass(frozen=True)
class ConstrainedProposals:
    """Proposals of the model, optimized under constraints, one after the other.

    Attributes:
        count: Number of proposals for each pair of start and goal.
        temperature: Factor on the standard deviation of their initial noise.
    """

    count: int
    temperature: float = 1.0

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first that becomes valid, or None."""
        if context.stop():
            return None
        with context.report.timed("propose"):
            proposed = context.sampler.propose(context.queries, self.count, self.temperature)
        with context.report.timed("repair"):
            for control in () if proposed is None else proposed:
                context.report.candidates += 1
                context.report.proposed += 1
                found = None if context.stop() else on_constraints(context).repaired(control)
                if found is not None:
                    return Solution(Path(found[1]), PROPOSED)
        return None


ITERATIONS, GROWTH = 32768, 1.5  # of trees in the first turn, and factor from turn to turn
BETWEEN_TREES = 4  # most proposals in a turn that has trees, since each takes as long as some 500 iterations of them
TEMPERATURES = (1.0, 1.6, 2.0)  # of proposals in one turn after the other


@dataclass(frozen=True)
class ConstrainedTurns:
    """Turns of trees, each longer than the one before, and of proposals, until time is up.

    Attributes:
        trees: Whether there are trees.
        count: Largest number of proposals in a turn.
    """

    trees: bool
    count: int

    def run(self, context: SolveContext) -> Solution | None:
        """Return the first valid path, or None."""
        for turn in count() if self.trees or self.count else ():
            if context.stop():
                break
            stages: list[ConstrainedTrees | ConstrainedProposals] = []
            if self.trees:
                stages.append(ConstrainedTrees(round(ITERATIONS * GROWTH**turn)))
            if self.count:
                most = BETWEEN_TREES if self.trees else self.count
                stages.append(ConstrainedProposals(min(most, self.count), TEMPERATURES[turn % len(TEMPERATURES)]))
            for stage in stages:
                found = stage.run(context)
                if found is not None:
                    return found
        return None


@dataclass(frozen=True)
class ConstrainedShorten:
    """Shorter paths from other beginnings: shortcuts along the path of trees, the line, proposals.

    Attributes:
        count: Number of proposals that are tried.
        again: Whether proposals and trees go on until time is up.
    """

    count: int
    again: bool = False

    def run(self, context: SolveContext) -> None:
        """Accept shorter paths."""
        paths = on_constraints(context)
        with context.report.timed("polish"):
            for control in self._beginnings(context, paths):
                if context.stop():
                    return
                found = paths.shortened(control)
                if found is not None:
                    context.accept_if_shorter(Path(found[1]))

    def _beginnings(self, context: SolveContext, paths: ConstrainedPaths) -> Iterator[Array]:
        """Yield control points, each of shape (points, dof), near paths that may be shorter."""
        assert context.best is not None
        nodes, context.tree_nodes = context.tree_nodes, None
        if nodes is not None:
            yield paths.fit(self._shortcut(context, paths, nodes))
        else:
            yield paths.fit(context.best.states)
        pair = context.best.states[[0, -1]]
        yield context.optimizer.spline.line(*pair)
        if context.best.length > DETOUR * path_length(pair):
            yield from self._proposals(context)
        while self.again:
            found = ConstrainedTrees(ITERATIONS).search(context)
            if found is not None:
                yield paths.fit(self._shortcut(context, paths, found[0]))
            yield from self._proposals(context)

    def _proposals(self, context: SolveContext) -> Array:
        """Return control points of proposals, shape (B, points, dof)."""
        proposed = context.sampler.propose(context.queries, self.count) if self.count else None
        spline, dof = context.optimizer.spline, context.kernel.robot.dof
        return np.empty((0, spline.points, dof)) if proposed is None else proposed

    @staticmethod
    def _shortcut(context: SolveContext, paths: ConstrainedPaths, nodes: Array) -> Array:
        """Return nodes after shortcuts; the path through them is accepted where it is valid."""
        short = paths.shortcut(nodes, DRAWS, context.rng.spawn(1)[0])
        states = paths.along(short)
        if states is not None:
            context.accept_if_shorter(Path(states))
        return short
