"""A tree of states rooted at goals, whose edges were clear when they were last looked at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from apex_ompl.types import Array

Clear = Callable[[Array], NDArray[np.bool_]]


class GoalTree:
    """A rapidly exploring random tree rooted at goals."""

    def __init__(self, goals: Array, step: float, resolution: float, most: int) -> None:
        """Begin with the roots alone.

        Args:
            goals: Shape (goals, dof).
            step: Largest length of an edge [rad, max-norm].
            resolution: Largest spacing of the states that are looked at on it [rad, max-norm].
            most: Number of nodes that there is room for besides the roots.
        """
        self.step, self.roots, self._count = step, len(goals), len(goals)
        self._shares = np.linspace(0.0, 1.0, int(np.ceil(step / resolution)) + 1)[1:, None]
        room, dof = len(goals) + most, goals.shape[1]
        self._states, self._parents = np.empty((room, dof)), np.full(room, -1)
        self._checks = np.empty((room, len(self._shares), dof))
        self._states[: self.roots] = goals

    def __len__(self) -> int:
        """Return the number of nodes."""
        return self._count

    @property
    def states(self) -> Array:
        """States of the nodes, shape (N, dof); those of the roots first."""
        return self._states[: self._count]

    @property
    def parents(self) -> NDArray[np.int64]:
        """Number of the parent of each node, shape (N,), less than its own; -1 of a root."""
        return self._parents[: self._count]

    @property
    def edges(self) -> Array:
        """States at which the edges of the nodes behind the roots are looked at, shape (N - roots, C, dof)."""
        return self._checks[self.roots : self._count]

    @property
    def full(self) -> bool:
        """Whether there is room for no more."""
        return self._count == len(self._states)

    def at(self, q: Array) -> int:
        """Return the number of the node that is at a state, shape (dof,), or -1."""
        found = np.flatnonzero((self.states == q).all(axis=1))
        return int(found[0]) if len(found) else -1

    def nearest(self, q: Array) -> int:
        """Return the number of the node nearest to a state, shape (dof,)."""
        return int(np.argmin(np.square(self.states - q).sum(axis=1)))

    def extend(self, node: int, q: Array, clear: Clear) -> int:
        """Grow the tree from a node towards a state by one step; return the number of the new node, or -1."""
        way = q - self.states[node]
        length = float(np.abs(way).max())
        if length == 0.0 or self.full:
            return -1
        checks = self.states[node] + min(1.0, self.step / length) * self._shares * way
        if length <= self.step:
            checks[-1] = q
        if not clear(checks).all():
            return -1
        k = self._count
        self._states[k], self._parents[k], self._checks[k] = checks[-1], node, checks
        self._count += 1
        return k

    def trim(self, clear: Clear) -> None:
        """Remove the nodes whose edges are no longer clear, and all behind them."""
        kept = np.ones(self._count, bool)
        edges = self.edges
        kept[self.roots :] = clear(edges.reshape(-1, edges.shape[2])).reshape(edges.shape[:2]).all(axis=1)
        for k in range(self.roots, self._count):
            kept[k] &= kept[self._parents[k]]
        number, left = np.cumsum(kept) - 1, int(kept.sum())
        parents = self.parents[kept]
        self._parents[:left] = np.where(parents < 0, -1, number[parents])
        self._states[:left], self._checks[:left] = self.states[kept], self._checks[: self._count][kept]
        self._count = left

    def path(self, node: int) -> Array:
        """Return the states from a node to its root, shape (L, dof)."""
        found = [node]
        while self.parents[found[-1]] >= 0:
            found.append(int(self.parents[found[-1]]))
        return np.asarray(self.states[found])
