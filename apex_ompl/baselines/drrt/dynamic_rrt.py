"""Dynamic RRT: a tree rooted at goals that is trimmed where obstacles changed, and grown again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from apex_ompl.types import Array, Flags, Indices

AreFree = Callable[[Array, Array], Flags]
"""Whether straight motions are free, shape (N,), from states of shape (N, dof) to states of shape (N, dof)."""

FIRST_ROOM = 1024  # initial capacity in nodes


class GoalTree:
    """A rapidly exploring random tree rooted at goals."""

    def __init__(self, goals: Array, step: float, most: int | None = None) -> None:
        """Start with the roots alone.

        Args:
            goals: Shape (goals, dof).
            step: Largest length of an edge [rad, max-norm].
            most: Largest number of nodes besides the roots; None for any number.
        """
        self.step, self.roots, self._count = step, len(goals), len(goals)
        self._most = None if most is None else len(goals) + most
        room = len(goals) + (FIRST_ROOM if most is None else most)
        self._states, self._parents = np.empty((room, goals.shape[1])), np.full(room, -1)
        self._squares = np.empty(room)
        self._states[: self.roots] = goals
        self._squares[: self.roots] = np.square(goals).sum(axis=1)

    def __len__(self) -> int:
        """Return the number of nodes."""
        return self._count

    @property
    def states(self) -> Array:
        """States of the nodes, shape (N, dof); those of the roots first."""
        return self._states[: self._count]

    @property
    def parents(self) -> Indices:
        """Number of the parent of each node, shape (N,), less than its own; -1 of a root."""
        return self._parents[: self._count]

    @property
    def full(self) -> bool:
        """Whether the tree has its largest number of nodes."""
        return self._count == self._most

    @property
    def edges(self) -> tuple[Array, Array]:
        """States of the parents of all nodes after the roots, and of the nodes, each of shape (N - roots, dof)."""
        return self.states[self.parents[self.roots :]], self.states[self.roots :]

    def at(self, q: Array) -> int:
        """Return the number of the node that is at a state, shape (dof,), or -1."""
        found = np.flatnonzero((self.states == q).all(axis=1))
        return int(found[0]) if len(found) else -1

    def nearest(self, q: Array) -> int:
        """Return the number of the node nearest to a state, shape (dof,), by Euclidean distance."""
        return int(np.argmin(self._squares[: self._count] - 2.0 * (self.states @ q)))

    def extend(self, node: int, q: Array, free: AreFree) -> int:
        """Grow the tree from a node towards a state by one step; return the number of the new node, or -1."""
        way = q - self.states[node]
        length = float(np.abs(way).max())
        if length == 0.0 or self.full:
            return -1
        new = q if length <= self.step else self.states[node] + self.step / length * way
        if not free(self.states[node][None], new[None])[0]:
            return -1
        k = self._count
        if k == len(self._states):
            self._grow_room()
        self._states[k], self._parents[k], self._squares[k] = new, node, new @ new
        self._count += 1
        return k

    def _grow_room(self) -> None:
        """Make room for twice as many nodes."""
        self._states = np.concatenate([self._states, np.empty_like(self._states)])
        self._parents = np.concatenate([self._parents, np.full_like(self._parents, -1)])
        self._squares = np.concatenate([self._squares, np.empty_like(self._squares)])

    def trim(self, free: AreFree) -> int:
        """Remove the nodes whose edges are no longer free, and all after them; return their number."""
        kept = np.ones(self._count, bool)
        kept[self.roots :] = free(*self.edges)
        for k in range(self.roots, self._count):
            kept[k] &= kept[self._parents[k]]
        number, left, before = np.cumsum(kept) - 1, int(kept.sum()), self._count
        parents = self.parents[kept]
        self._parents[:left] = np.where(parents < 0, -1, number[parents])
        self._states[:left], self._squares[:left] = self.states[kept], self._squares[:before][kept]
        self._count = left
        return before - left

    def path(self, node: int) -> Array:
        """Return the states from a node to its root, shape (L, dof)."""
        found = [node]
        while self.parents[found[-1]] >= 0:
            found.append(int(self.parents[found[-1]]))
        return np.asarray(self.states[found])


@dataclass(eq=False)
class DynamicRRT:
    """Dynamic RRT (Ferguson, Kalra and Stentz 2006, "Replanning with RRTs"; Connell and La 2017 compare with it).

    The tree is rooted at the goals, so that it stays useful while the robot moves. Before it is grown again, edges that
    are no longer free are removed with their descendants. It grows until it has a start: towards a start, towards
    states of the last path (the way-point cache of Bruce and Veloso 2002, "Real-time randomized path planning for robot
    navigation"), or towards random states. Without a last path random states replace way-points, which is RRT from the
    goal.

    The paper leaves open the length of steps, the distance (here Euclidean, steps by the largest change of a joint),
    the number of way-points (here the nodes of the last path), several goals (here all are roots), and the size of a
    tree over many calls (here it may be bounded, and then is built again).

    Attributes:
        step: Largest length of an edge [rad, max-norm].
        to_start: Share of the extensions towards a start.
        to_waypoint: Share of those towards states of the last path.
        most: Number of nodes at which the tree is built again; None for any number.
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

    def rooted_at(self, goals: Array) -> GoalTree:
        """Return the tree of goals, shape (goals, dof): the kept one, or a new one where the goals changed."""
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
            tree: What :meth:`rooted_at` returned, trimmed.
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
