"""Dynamic RRT: a tree rooted at the goals that is trimmed where obstacles changed, and grown again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from apex_ompl.baselines.drrt.goal_tree import AreFree, GoalTree
from apex_ompl.types import Array


@dataclass(eq=False)
class DynamicRRT:
    """Dynamic RRT (Ferguson, Kalra and Stentz 2006, "Replanning with RRTs"; Connell and La 2017 compare with it).

    The tree is rooted at the goals, so that it stays of use while the robot moves. Before it is grown again, edges that
    are no longer free are removed with all behind them. It grows until it has a start: towards a start, towards states
    of the last path (the way-point cache of Bruce and Veloso 2002, "Real-time randomized path planning for robot
    navigation"), or towards random states. Without a last path these take the place of way-points, and what is left is
    RRT from the goal.

    The paper leaves open how long steps are, the distance (here Euclidean, steps by the largest change of a joint), how
    many way-points are kept (here the nodes of the last path), several goals (here roots alike), and a tree that is
    long kept (here it may be bounded, and then begins anew).

    Attributes:
        step: Largest length of an edge [rad, max-norm].
        to_start: Share of the extensions towards a start.
        to_waypoint: Share of those towards states of the last path.
        most: Number of nodes from which on the tree begins anew; None for any number.
        tree: The tree, or None.
        waypoints: Nodes of the last path, shape (L, dof), or None.
    """

    step: float
    to_start: float
    to_waypoint: float
    most: int | None = None
    tree: GoalTree | None = None
    waypoints: Array | None = None

    def forget(self) -> None:
        """Forget the tree and the last path."""
        self.tree, self.waypoints = None, None

    def begin(self, goals: Array) -> GoalTree:
        """Return the tree of goals, shape (goals, dof): the one that is kept, or a new one where these are others."""
        tree = self.tree
        if tree is None or tree.full or not np.array_equal(tree.states[: tree.roots], goals):
            tree = self.tree = GoalTree(goals, self.step, self.most)
        return tree

    def grow(
        self, tree: GoalTree, starts: Array, sample: Callable[[], Array], *,
        rng: np.random.Generator, free: AreFree, stop: Callable[[], bool],
    ) -> Array | None:  # fmt: skip
        """Grow the tree until it has a start; return the path from there to a goal, shape (L, dof), or None.

        Args:
            tree: What :meth:`begin` returned, trimmed.
            starts: Start states, shape (S, dof).
            sample: Draws a random state, shape (dof,); called once for each extension.
            rng: Source of the other random choices.
            free: Whether straight motions are free.
            stop: Asked before each extension whether to give up.
        """
        node = max(tree.at(start) for start in starts)
        while node < 0 and not stop() and not tree.full:
            kind, q = rng.random(), sample()
            start = starts[int(rng.integers(len(starts)))] if len(starts) > 1 else starts[0]
            if kind < self.to_start:
                q = start
            elif kind < self.to_start + self.to_waypoint and self.waypoints is not None:
                q = self.waypoints[rng.integers(len(self.waypoints))]
            grown = tree.extend(tree.nearest(q), q, free)
            if grown < 0:
                continue
            way = np.abs(starts - tree.states[grown]).max(axis=1)
            k = int(np.argmin(way))
            if way[k] == 0.0:
                node = grown
            elif way[k] <= self.step:
                node = tree.extend(grown, starts[k], free)
        if node < 0:
            return None
        self.waypoints = tree.path(node)
        return self.waypoints
