"""Shortest free paths in a graph of states whose edges are checked when a path uses them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.kernel.compiled.graph_search import shortest_path
from apex_ompl.roadmaps.goal_tree import AreFree
from apex_ompl.types import Array, Flags, Indices


@dataclass(frozen=True, eq=False)
class Graph:
    """An undirected graph of states; each edge is stored in both directions, by the node that it begins at.

    Attributes:
        states: States of the nodes, shape (N, dof).
        begins: First edge of each node, shape (N + 1,).
        ends: Node that each edge leads to, shape (E,).
        twins: The same edge in the other direction, shape (E,).
        lengths: Euclidean length of each edge, shape (E,) [rad].
    """

    states: Array
    begins: Indices
    ends: Indices
    twins: Indices
    lengths: Array

    @classmethod
    def of(cls, states: Array, pairs: Indices) -> Graph:
        """Return the graph with given edges, shape (M, 2); those that are given twice, or join a node to itself, once.

        Args:
            states: Shape (N, dof).
            pairs: Numbers of nodes.
        """
        count = len(states)
        both = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int64)
        keys = np.unique(both[both[:, 0] != both[:, 1]] @ np.array([count, 1]))
        first, ends = np.divmod(keys, count)
        begins = np.searchsorted(first, np.arange(count + 1))
        twins = np.searchsorted(keys, ends * count + first)
        return cls(states, begins, ends, twins, np.linalg.norm(states[ends] - states[first], axis=1))

    @property
    def firsts(self) -> Indices:
        """Node that each edge begins at, shape (E,)."""
        return np.repeat(np.arange(len(self.states)), np.diff(self.begins))


class _Found(NamedTuple):
    """A path by numbers: of its start, of its nodes, of its edges, and of its goal."""

    start: int
    nodes: list[int]
    edges: list[int]
    goal: int


class LazySearch:
    """A* whose edges are checked where the shortest path uses them, until one is free (Bohlin and Kavraki 2000).

    Attributes:
        graph: The graph.
        searches: Number of searches so far.
        checked: Number of motions that were checked.
    """

    def __init__(self, graph: Graph, open_nodes: Flags, starts: Array, goals: Array) -> None:
        """Begin with all edges between nodes that may be used.

        Args:
            graph: The graph.
            open_nodes: Which nodes may be used, shape (N,).
            starts: Start states, shape (S, dof).
            goals: Goal states, shape (G, dof).
        """
        self.graph, self.searches, self.checked = graph, 0, 0
        self._starts, self._goals = starts, goals
        self._usable = (open_nodes[graph.ends] & open_nodes[graph.firsts]).astype(np.int64)
        self._known = np.zeros(len(graph.ends), bool)
        count, edges = len(graph.states), len(graph.ends)
        self._entry, self._leave = np.full((len(starts), count), np.inf), np.full((len(goals), count), np.inf)
        away = [np.linalg.norm(graph.states - goal, axis=1) for goal in goals]
        self._heuristic = np.min(away, axis=0)
        room = count + edges
        self._buffers = np.empty(count), np.empty(count, np.int64), np.empty(room), np.empty(room, np.int64)
        self._free_ends: set[tuple[bool, int, int]] = set()

    def connect(self, start: int | None = None, goal: int | None = None, *, nodes: Indices) -> None:
        """Let the path enter the graph from a start, or leave it for a goal, given by number, over some nodes."""
        row, q = (self._entry[start], self._starts[start]) if start is not None else (
            self._leave[goal], self._goals[goal]
        )  # fmt: skip
        row[nodes] = np.linalg.norm(self.graph.states[nodes] - q, axis=1)

    def run(self, free: AreFree, stop: Callable[[], bool], searched: Callable[[], None] = lambda: None) -> Array | None:
        """Return the shortest path whose motions are free, shape (L, dof), or None.

        Args:
            free: Whether straight motions are free.
            stop: Asked before each search and each check whether to give up.
            searched: Called after each search.
        """
        while not stop():
            found = self._search()
            searched()
            if found is None:
                return None
            if self._check(found, free, stop):
                nodes = self.graph.states[found.nodes]
                return np.concatenate([self._starts[[found.start]], nodes, self._goals[[found.goal]]])
        return None

    def _search(self) -> _Found | None:
        """Return the shortest path, or None."""
        self.searches += 1
        graph, (cost, parent, keys, heap) = self.graph, self._buffers
        node = int(shortest_path(
            graph.begins, graph.ends, graph.lengths, self._usable, self._entry.min(axis=0), self._leave.min(axis=0),
            self._heuristic, cost, parent, keys, heap,
        ))  # fmt: skip
        if node < 0:
            return None
        goal, nodes, edges = int(np.argmin(self._leave[:, node])), [node], list[int]()
        while parent[nodes[-1]] >= 0:
            edge = int(parent[nodes[-1]])
            edges.append(edge)
            nodes.append(int(graph.ends[graph.twins[edge]]))
        return _Found(int(np.argmin(self._entry[:, nodes[-1]])), nodes[::-1], edges[::-1], goal)

    def _check(self, found: _Found, free: AreFree, stop: Callable[[], bool]) -> bool:
        """Check what is unknown of a path, the longest motion first; the first that is blocked is not used again."""
        states, graph = self.graph.states, self.graph
        inner = [e for e in found.edges if not self._known[e]]
        for at_start, row, k in ((True, found.start, found.nodes[0]), (False, found.goal, found.nodes[-1])):
            if (at_start, row, k) in self._free_ends:
                continue
            if stop():
                return False
            ends = (self._starts[row], states[k]) if at_start else (states[k], self._goals[row])
            self.checked += 1
            if not free(ends[0][None], ends[1][None])[0]:
                (self._entry if at_start else self._leave)[row, k] = np.inf
                return False
            self._free_ends.add((at_start, row, k))
        for e in sorted(inner, key=lambda e: -float(graph.lengths[e])):
            if stop():
                return False
            twin = int(graph.twins[e])
            self.checked += 1
            if not free(states[[graph.ends[twin]]], states[[graph.ends[e]]])[0]:
                self._usable[[e, twin]] = 0
                return False
            self._known[[e, twin]] = True
        return True
