"""RRT-Connect inside APEX: sprints before proposals, bridges, and turns of growing length that make it complete.

Where this project's checker decides, trees grow in compiled code (:class:`apex_ompl.kernel.search.TreePair`), several
times as fast as OMPL's, which ask for each motion. They go only where the spheres prove that it is free; OMPL's
RRTConnect, with the exact check, has its turns beside them, and is what runs with another checker, and for a robot of
whose free states the spheres prove few (:mod:`apex_ompl.collision.proved_share`).

Bridges are short trees that plan blocked stretches of the best candidates anew. At the end of the search, turns of
trees and rounds of proposals share what time is left.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex.context import SolveContext, joins
from apex_ompl.apex.models import PerturbationModel
from apex_ompl.apex.path_validator import PathValidator
from apex_ompl.apex.stages.proposals import Farthest
from apex_ompl.apex.stages.stage import Solution, Stage, run_stage
from apex_ompl.kernel.search import TreePair
from apex_ompl.ompl.space import path_to_array, to_state
from apex_ompl.paths.path import SEARCH_RESOLUTION, Path
from apex_ompl.types import Array

OMPL_RANGE = 0.2  # OMPL's choice of the longest step, as a share of the extent of the space
OMPL_SHARE = 0.125  # of the iterations of compiled trees that OMPL's have, which take several times as long for one
EXACT_SHARE = 1 / 32  # the same, in a sprint
OmplTrees = tuple[og.RRTConnect, ob.ProblemDefinition]


def ompl_trees(si: ob.SpaceInformation, starts: Sequence[Array], goal: Array | ob.Goal, tree_range: float) -> OmplTrees:
    """Return OMPL's RRTConnect, and its problem definition, between starts and a goal.

    Args:
        si: OMPL's space information.
        starts: Start states, each of shape (dof,).
        goal: A state, shape (dof,), or OMPL's goal.
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
    """
    pdef = ob.ProblemDefinition(si)
    for start in starts:
        pdef.addStartState(to_state(si, start))
    if isinstance(goal, np.ndarray):
        pdef.setGoalState(to_state(si, goal))
    else:
        pdef.setGoal(goal)
    tree = og.RRTConnect(si)
    if tree_range > 0.0:
        tree.setRange(tree_range)
    tree.setProblemDefinition(pdef)
    tree.setup()
    return tree, pdef


def compiled_trees(
    context: SolveContext, starts: Sequence[Array], goals: Sequence[Array], tree_range: float
) -> TreePair:  # fmt: skip
    """Return trees in compiled code from starts to goals, each of shape (dof,); a range of 0 is OMPL's choice [rad]."""
    longest = tree_range if tree_range > 0.0 else OMPL_RANGE * context.si.getStateSpace().getMaximumExtent()
    rng = context.rng.spawn(1)[0]
    return TreePair(context.kernel, np.array(starts), np.array(goals), longest, SEARCH_RESOLUTION, rng)


def rooted_trees(
    context: SolveContext, starts: Sequence[Array], goals: Sequence[Array], tree_range: float
) -> TreePair:  # fmt: skip
    """Return compiled trees whose roots are starts and goals of the problem; OMPL's planner data are theirs."""
    trees = compiled_trees(context, starts, goals, tree_range)
    context.grown.append(trees)
    return trees


def rooted_ompl_trees(
    context: SolveContext, starts: Sequence[Array], goal: Array | ob.Goal, tree_range: float
) -> OmplTrees:  # fmt: skip
    """Return OMPL's trees whose roots are starts and goals of the problem; OMPL's planner data are theirs."""
    trees = ompl_trees(context.validator.si, starts, goal, tree_range)
    context.grown.append(trees[0])
    return trees


def grow(context: SolveContext, trees: TreePair, iterations: int) -> Array | None:
    """Return the path of compiled trees after some more iterations, or None; add their checks to the counts."""
    found = trees.grow(iterations, context.stop)
    context.note_search(trees.take_counts())
    return found


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
    if context.validator.by_spheres:
        found = grow(context, compiled_trees(context, [a], [b], tree_range), calls)
        if found is not None:
            return found
        calls = round(OMPL_BRIDGE_SHARE * calls)
    tree, pdef = ompl_trees(context.validator.si, [a], b, tree_range)
    if tree.solve(context.counted(calls)).getStatus() != ob.PlannerStatus.EXACT_SOLUTION:
        return None
    inner = path_to_array(pdef.getSolutionPath(), len(a))
    return np.concatenate([a[None], inner[1:-1], b[None]])


SPACING = 0.1  # of states on a tree's path whose blocked stretches are bridged [rad, max-norm]
GUIDING, EVERY = 8, 8  # candidates around whose states trees grow, the nearest to being free, and every so many states
EXACT, APPROXIMATE = ob.PlannerStatus.EXACT_SOLUTION, ob.PlannerStatus.APPROXIMATE_SOLUTION


@dataclass(frozen=True)
class Sprint:
    """RRT-Connect for some iterations between the nearest start and goal; it goes on where it stopped before.

    In open scenes it is done sooner than proposals are made.

    Attributes:
        iterations: Number of iterations of compiled trees; OMPL's have OMPL_SHARE of it where another checker decides.
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        exact: Whether OMPL's trees, with the exact check, go on after compiled ones where there is no trained model.
    """

    iterations: int
    tree_range: float
    exact: bool = False

    def run(self, context: SolveContext) -> Solution | None:
        """Return the path of the trees, or None."""
        if context.stop():
            return None
        with context.report.timed("sprint"):
            if not context.validator.by_spheres:
                states = self._of_ompl(context, self.iterations)
            else:
                states = self._compiled(context)
                if states is None and self.exact and isinstance(context.sampler.model, PerturbationModel):
                    states = self._of_ompl(context, math.ceil(EXACT_SHARE * self.iterations))
        return None if states is None else verified(context, states, "sprint", self)

    def _compiled(self, context: SolveContext) -> Array | None:
        trees, (start, goal) = context.sprint_trees, context.pairs[0]
        trees = context.sprint_trees = trees or rooted_trees(context, [start], [goal], self.tree_range)
        trees.guide(_guides(context, context.pairs[:1]))
        states = grow(context, trees, self.iterations)
        if states is not None:
            context.sprint_trees = None
        return states

    def _of_ompl(self, context: SolveContext, iterations: int) -> Array | None:
        """Return the path of OMPL's trees, with OMPL's longest step first: other checkers' scenes may be wide open."""
        start, goal = context.pairs[0]
        exclusive = context.validator.exclusive
        calls = iterations if exclusive else math.ceil(OMPL_SHARE * iterations)
        for tree_range in (self.tree_range,) if exclusive else dict.fromkeys((0.0, self.tree_range)):
            trees = context.sprint_ompl_trees.get(tree_range)
            trees = trees or rooted_ompl_trees(context, [start], goal, tree_range)
            tree, pdef = context.sprint_ompl_trees[tree_range] = trees
            if tree.solve(context.counted(calls)).getStatus() == EXACT:
                context.sprint_ompl_trees.clear()
                return path_to_array(pdef.getSolutionPath(), context.kernel.robot.dof)
        return None


@dataclass(frozen=True)
class GrowTrees:
    """RRT-Connect for all starts and goals; it goes on where it stopped before.

    The trees of sprints go on where there is only one pair of start and goal, and OMPL's where no more goals can come.
    Compiled trees go to the goals that were read before; OMPL's draw more of a region.

    Attributes:
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        approximate: Whether a path that ends near a goal is noted.
    """

    tree_range: float
    approximate: bool

    def run(self, context: SolveContext, iterations: int) -> Solution | None:
        """Return the path of the trees after some more iterations, of which OMPL's have OMPL_SHARE, or None."""
        if context.validator.by_spheres:
            found = self._compiled(context, iterations)
            if found is not None:
                return found
        return self._of_ompl(context, math.ceil(OMPL_SHARE * iterations))

    def _compiled(self, context: SolveContext, iterations: int) -> Solution | None:
        trees = context.all_trees or (context.sprint_trees if len(context.pairs) == 1 else None)
        trees = trees or rooted_trees(context, context.starts, context.goals, self.tree_range)
        context.sprint_trees, context.all_trees = None, trees
        trees.guide(_guides(context, context.pairs))
        with context.report.timed("rrtconnect"):
            states = grow(context, trees, iterations)
        if states is None:
            return None
        context.all_trees = None
        return verified(context, states, "rrtconnect", self)

    def _of_ompl(self, context: SolveContext, iterations: int) -> Solution | None:
        goal = context.pdef.getGoal()
        whole = len(context.pairs) == 1 and goal.hasType(ob.GOAL_STATE)  # a region may have others
        trees = context.all_ompl_trees or (context.sprint_ompl_trees.get(self.tree_range) if whole else None)
        trees = trees or rooted_ompl_trees(context, context.starts, goal, self.tree_range)
        context.sprint_ompl_trees, context.all_ompl_trees = {}, trees
        tree, pdef = trees
        with context.report.timed("rrtconnect"):
            status = tree.solve(context.counted(iterations)).getStatus()
        if status not in (EXACT, APPROXIMATE):
            return None
        states = path_to_array(pdef.getSolutionPath(), context.kernel.robot.dof)
        if status == EXACT:
            context.all_ompl_trees = None
            return verified(context, states, "rrtconnect", self)
        if self.approximate:
            distance = pdef.getSolutionDifference()
            if context.nearest is None or distance < context.nearest[1]:
                context.nearest = Path(states), distance
        return None


def _guides(context: SolveContext, pairs: Sequence[tuple[Array, Array]]) -> Array:
    """Return states of the candidates between some pairs of start and goal that are nearest to being free."""
    mine = [one for one in context.pool.candidates if any(joins(one.control, *pair) for pair in pairs)]
    best = sorted(mine, key=lambda one: one.clearance_cost)[:GUIDING]
    paths = [context.spline_path(one.control).states[EVERY // 2 :: EVERY] for one in best]
    return np.concatenate(paths) if paths else np.empty((0, context.kernel.robot.dof))


def verified(context: SolveContext, states: Array, stage: str, trees: Sprint | GrowTrees) -> Solution | None:
    """Return a tree's path if it passes the full check, whose states are closer, or after bridging; else None.

    Args:
        context: Shared by the stages.
        states: The path, shape (N, dof).
        stage: Name of the stage.
        trees: Gives the range of the trees that bridge.
    """
    found: Array | None = states
    if context.validator.exclusive and not context.is_valid(states):
        with context.report.timed("bridge"):
            dense = Path(states).sample(SPACING)
            found = bridge_blocked(context, dense, trees.tree_range)
    return None if found is None else Solution(Path(found), stage)


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
