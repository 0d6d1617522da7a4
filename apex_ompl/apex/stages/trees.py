"""RRT-Connect inside APEX: short sprints before proposals, and turns of growing length that make it complete.

Trees in compiled code grow first where this project's checker decides; OMPL's have their turns beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ompl import base as ob

from apex_ompl.apex.context import SolveContext, joins
from apex_ompl.apex.stages.bridging import bridge_blocked
from apex_ompl.apex.stages.stage import Solution
from apex_ompl.apex.trees import OMPL_SHARE, grow, rooted_ompl_trees, rooted_trees
from apex_ompl.ompl.space import path_to_array
from apex_ompl.paths.path import Path
from apex_ompl.types import Array

SPACING = 0.1  # of states on a tree's path whose blocked stretches are bridged [rad, max-norm]
GUIDING, EVERY = 8, 8  # candidates around whose states trees grow, the nearest to being free, and every so many states
EXACT, APPROXIMATE = ob.PlannerStatus.EXACT_SOLUTION, ob.PlannerStatus.APPROXIMATE_SOLUTION


@dataclass(frozen=True)
class Sprint:
    """RRT-Connect for some iterations between the nearest start and goal; it goes on where it stopped before.

    In open scenes it is done sooner than proposals are made.

    Attributes:
        iterations: Number of iterations of compiled trees; OMPL's have OMPL_SHARE of it.
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
    """

    iterations: int
    tree_range: float

    def run(self, context: SolveContext) -> Solution | None:
        """Return the path of the trees, or None."""
        if context.stop():
            return None
        with context.report.timed("sprint"):
            states = self._compiled(context) if context.validator.exclusive else self._of_ompl(context)
        return None if states is None else verified(context, states, "sprint", self)

    def _compiled(self, context: SolveContext) -> Array | None:
        trees, (start, goal) = context.sprint_trees, context.pairs[0]
        trees = context.sprint_trees = trees or rooted_trees(context, [start], [goal], self.tree_range)
        trees.guide(_guides(context, context.pairs[:1]))
        states = grow(context, trees, self.iterations)
        if states is not None:
            context.sprint_trees = None
        return states

    def _of_ompl(self, context: SolveContext) -> Array | None:
        """Return the path of OMPL's trees, with OMPL's longest step first: other checkers' scenes may be wide open."""
        start, goal = context.pairs[0]
        for tree_range in dict.fromkeys((0.0, self.tree_range)):
            trees = context.sprint_ompl_trees.get(tree_range)
            trees = trees or rooted_ompl_trees(context, [start], goal, tree_range)
            tree, pdef = context.sprint_ompl_trees[tree_range] = trees
            if tree.solve(context.counted(math.ceil(OMPL_SHARE * self.iterations))).getStatus() == EXACT:
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
        if context.validator.exclusive:
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
