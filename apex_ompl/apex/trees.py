"""Trees of RRT-Connect between starts and goals: in compiled code, and OMPL's own.

Where this project's checker decides, trees grow in compiled code (:class:`apex_ompl.kernel.search.TreePair`), several
times as fast as OMPL's, which ask for each motion. They go only where the spheres prove that it is free; OMPL's
RRTConnect, with the exact check, is the fallback, and what runs with another checker.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from ompl import base as ob
from ompl import geometric as og

from apex_ompl.apex.context import SolveContext
from apex_ompl.kernel.search import TreePair
from apex_ompl.ompl.space import to_state
from apex_ompl.types import Array
from apex_ompl.util.resolution import SEARCH_RESOLUTION

OMPL_RANGE = 0.2  # OMPL's choice of the longest step, as a share of the extent of the space
OMPL_SHARE = 0.125  # of the iterations of compiled trees that OMPL's have, which take several times as long for one
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
