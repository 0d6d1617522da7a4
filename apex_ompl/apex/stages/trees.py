"""RRT-Connect inside APEX: short sprints before proposals, and turns of growing length that make it complete.

Where this project's checker decides, trees grow in compiled code first (:class:`apex_ompl.kernel.trees.TreePair`),
several times as fast as OMPL's, which ask for each motion. They go only where the spheres prove that it is free; OMPL's
own RRTConnect, with the exact check, takes its turns beside them as the fallback.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex.bridge import bridge_blocked, compiled_trees, grow, make_tree
from apex_ompl.apex.context import SolveContext
from apex_ompl.apex.stages.stage import Solution
from apex_ompl.ompl_adapter.space import path_to_array, to_state
from apex_ompl.trajopt.path import Path
from apex_ompl.types import Array

SPACING = 0.1  # of states on a tree's path whose blocked stretches are bridged [rad, max-norm]
MORE = 2  # iterations of compiled trees for each of OMPL's
EXACT, APPROXIMATE = ob.PlannerStatus.EXACT_SOLUTION, ob.PlannerStatus.APPROXIMATE_SOLUTION


@dataclass(frozen=True)
class Sprint:
    """RRT-Connect for some iterations between the nearest start and goal; it goes on where it stopped before.

    In open scenes it is done sooner than proposals are made.

    Attributes:
        iterations: Number of iterations; compiled trees have MORE times as many.
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
        if context.pair_trees is None:
            start, goal = context.pairs[0]
            context.pair_trees = compiled_trees(context, start[None], goal[None], self.tree_range)
        states = grow(context, context.pair_trees, MORE * self.iterations)
        if states is not None:
            context.pair_trees = None
        return states

    def _of_ompl(self, context: SolveContext) -> Array | None:
        if context.trees is None:
            pdef = ob.ProblemDefinition(context.si)
            pdef.setStartAndGoalStates(*(to_state(context.si, q) for q in context.pairs[0]))
            context.trees = make_tree(context.si, pdef, self.tree_range), pdef
        tree, pdef = context.trees
        if tree.solve(context.counted(self.iterations)).getStatus() != EXACT:
            return None
        context.trees = None
        return path_to_array(pdef.getSolutionPath(), context.kernel.robot.dof)


@dataclass(frozen=True)
class GrowTrees:
    """RRT-Connect for all starts and goals; it goes on where it stopped before.

    The trees of sprints go on where there is only one pair of start and goal.

    Attributes:
        tree_range: Longest step of the trees; 0 lets OMPL choose [rad].
        approximate: Whether a path that ends near a goal is noted.
    """

    tree_range: float
    approximate: bool

    def run(self, context: SolveContext, iterations: int) -> Solution | None:
        """Return the path of the trees after some more iterations, or None."""
        if context.validator.exclusive:
            found = self._compiled(context, MORE * iterations)
            if found is not None:
                return found
        return self._of_ompl(context, iterations)

    def _compiled(self, context: SolveContext, iterations: int) -> Solution | None:
        trees = context.all_pair_trees or (context.pair_trees if len(context.pairs) == 1 else None)
        context.pair_trees = None
        if trees is None:
            trees = compiled_trees(context, np.array(context.starts), np.array(context.goals), self.tree_range)
        context.all_pair_trees = trees
        with context.report.timed("rrtconnect"):
            states = grow(context, trees, iterations)
        if states is None:
            return None
        context.all_pair_trees = None
        return verified(context, states, "rrtconnect", self)

    def _of_ompl(self, context: SolveContext, iterations: int) -> Solution | None:
        begun = context.all_trees or (context.trees if len(context.pairs) == 1 else None)
        context.trees, context.all_trees = None, begun or self._plant(context)
        tree, pdef = context.all_trees
        with context.report.timed("rrtconnect"):
            status = tree.solve(context.counted(iterations)).getStatus()
        if status not in (EXACT, APPROXIMATE):
            return None
        states = path_to_array(pdef.getSolutionPath(), context.kernel.robot.dof)
        if status == EXACT:
            context.all_trees = None
            return verified(context, states, "rrtconnect", self)
        if self.approximate:
            distance = pdef.getSolutionDifference()
            if context.nearest is None or distance < context.nearest[1]:
                context.nearest = Path(states), distance
        return None

    def _plant(self, context: SolveContext) -> tuple[og.RRTConnect, ob.ProblemDefinition]:
        """Return RRTConnect for all starts and goals, and its problem definition."""
        pdef = ob.ProblemDefinition(context.si)
        for start in context.starts:
            pdef.addStartState(to_state(context.si, start))
        pdef.setGoal(context.pdef.getGoal())
        return make_tree(context.si, pdef, self.tree_range), pdef


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
