"""Shortest free paths in a graph of states whose edges are checked when a path uses them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from apex_ompl.baselines.drrt.dynamic_rrt import AreFree
from apex_ompl.kernel import search
from apex_ompl.types import Array, Flags, Indices

Motion = tuple[str, int, int]
"""A motion of a search: ``start`` or ``goal``, its number, and a node; or ``edge``, its number, and its twin's."""


@dataclass(frozen=True, eq=False)
class Graph:
    """An undirected graph of states; each edge is stored in both directions, by the node that it starts at.

    Attributes:
        states: States of the nodes, shape (N, dof).
        first_edges: First edge of each node, shape (N + 1,).
        ends: Node that each edge leads to, shape (E,).
        twins: The same edge in the other direction, shape (E,).
        lengths: Euclidean length of each edge, shape (E,) [rad].
    """

    states: Array
    first_edges: Indices
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
        first_edges = np.searchsorted(first, np.arange(count + 1))
        twins = np.searchsorted(keys, ends * count + first)
        return cls(states, first_edges, ends, twins, np.linalg.norm(states[ends] - states[first], axis=1))

    @property
    def firsts(self) -> Indices:
        """Node that each edge starts at, shape (E,)."""
        return np.repeat(np.arange(len(self.states)), np.diff(self.first_edges))


class _Found(NamedTuple):
    """A path by numbers: of its start, of its nodes, of its edges, and of its goal."""

    start: int
    nodes: list[int]
    edges: list[int]
    goal: int


class LazySearch:
    """A* whose nodes and edges are checked where the shortest path uses them, until it is free.

    As in lazy PRM (Bohlin and Kavraki 2000, "Path planning using lazy PRM"): nodes of a path are checked before its
    motions, these from the longest on; what is blocked is not used again.

    Attributes:
        graph: The graph.
        searches: Number of searches so far.
        checked: Number of motions that were checked.
        motion: The motion that is being checked.
        more: Asked, where no path is left, to connect more nodes; returns whether there were any.
    """

    def __init__(
        self, graph: Graph, usable: Flags, starts: Array, goals: Array, *, free_nodes: Flags | None = None
    ) -> None:  # fmt: skip
        """Start with all edges between nodes that may be used.

        Args:
            graph: The graph.
            usable: Which nodes may be used, shape (N,).
            starts: Start states, shape (S, dof).
            goals: Goal states, shape (G, dof).
            free_nodes: Which nodes are known to be free, shape (N,); by default those that may be used.
        """
        self.graph, self.searches, self.checked, self.motion = graph, 0, 0, ("edge", 0, 0)
        self.more: Callable[[], bool] = lambda: False
        self._starts, self._goals = starts, goals
        self._usable = (usable[graph.ends] & usable[graph.firsts]).astype(np.int64)
        self._free_nodes = (usable if free_nodes is None else free_nodes).copy()
        self._free: set[Motion] = set()
        self._blocked: set[Motion] = set()
        self._hit = np.zeros(len(graph.states), bool)
        count = len(graph.states)
        self._entry, self._leave = np.full((len(starts), count), np.inf), np.full((len(goals), count), np.inf)
        away = [np.linalg.norm(graph.states - goal, axis=1) for goal in goals]
        self._heuristic = np.min(away, axis=0)
        self._shortest = search.GraphSearch(search.Graph(graph.first_edges, graph.ends, graph.lengths))

    def connect(self, start: int | None = None, goal: int | None = None, *, nodes: Indices) -> None:
        """Let the path enter the graph from a start, or leave it for a goal, given by number, over some nodes.

        Nodes and motions that are known to be blocked stay unused.
        """
        row, q = (self._entry[start], self._starts[start]) if start is not None else (
            self._leave[goal], self._goals[goal]
        )  # fmt: skip
        row[nodes] = np.where(self._hit[nodes], np.inf, np.linalg.norm(self.graph.states[nodes] - q, axis=1))
        for kind, number, node in self._blocked:
            if (kind, number) in (("start", start), ("goal", goal)):
                row[node] = np.inf

    def block(self, motion: Motion) -> None:
        """Use a motion no more."""
        self._blocked.add(motion)
        kind, first, second = motion
        if kind == "edge":
            self._usable[[first, second]] = 0
        else:
            (self._entry if kind == "start" else self._leave)[first, second] = np.inf

    def run(
        self, free: AreFree, stop: Callable[[], bool], searched: Callable[[int], None] = lambda reached: None,
        nodes_free: Callable[[Array], Flags] = lambda states: np.ones(len(states), bool),
    ) -> Array | None:  # fmt: skip
        """Return the shortest path whose motions are free, shape (L, dof), or None.

        Args:
            free: Whether straight motions are free.
            stop: Asked before each search and each check whether to give up.
            searched: Called after each search with the number of nodes that it reached.
            nodes_free: Whether states, shape (N, dof), are free; asked for nodes that are not known to be.
        """
        while not stop():
            found = self._search()
            searched(int(np.isfinite(self._shortest.cost).sum()))
            if found is None:
                if not self.more():
                    return None
                continue
            if self._check_nodes(found, nodes_free) and self._check_motions(found, free, stop):
                nodes = self.graph.states[found.nodes]
                return np.concatenate([self._starts[[found.start]], nodes, self._goals[[found.goal]]])
        return None

    def _search(self) -> _Found | None:
        """Return the shortest path, or None."""
        self.searches += 1
        graph, parent = self.graph, self._shortest.parent
        node = self._shortest.last_node(
            self._usable, self._entry.min(axis=0), self._leave.min(axis=0), self._heuristic
        )  # fmt: skip
        if node < 0:
            return None
        goal, nodes, edges = int(np.argmin(self._leave[:, node])), [node], list[int]()
        while parent[nodes[-1]] >= 0:
            edge = int(parent[nodes[-1]])
            edges.append(edge)
            nodes.append(int(graph.ends[graph.twins[edge]]))
        return _Found(int(np.argmin(self._entry[:, nodes[-1]])), nodes[::-1], edges[::-1], goal)

    def _check_nodes(self, found: _Found, nodes_free: Callable[[Array], Flags]) -> bool:
        """Check the nodes of a path that are not known to be free; those that are not are not used again."""
        left = np.array([k for k in found.nodes if not self._free_nodes[k]], np.int64)
        if not len(left):
            return True
        free = nodes_free(self.graph.states[left])
        self._free_nodes[left[free]] = True
        self._hit[left[~free]] = True
        for k in left[~free]:
            self._entry[:, k] = self._leave[:, k] = np.inf
            out = np.arange(self.graph.first_edges[k], self.graph.first_edges[k + 1])
            self._usable[out] = self._usable[self.graph.twins[out]] = 0
        return bool(free.all())

    def _check_motions(self, found: _Found, free: AreFree, stop: Callable[[], bool]) -> bool:
        """Check the motions of a path that are not known to be free, the longest first, up to one that is blocked."""
        states, graph = self.graph.states, self.graph
        first, last = found.nodes[0], found.nodes[-1]
        motions: list[tuple[float, Motion, Array, Array]] = [
            (self._entry[found.start, first], ("start", found.start, first), self._starts[found.start], states[first]),
            (self._leave[found.goal, last], ("goal", found.goal, last), states[last], self._goals[found.goal]),
        ]
        for edge in found.edges:
            twin, length = int(graph.twins[edge]), graph.lengths[edge]
            key = ("edge", min(edge, twin), max(edge, twin))
            motions.append((length, key, states[graph.ends[twin]], states[graph.ends[edge]]))
        for _, motion, a, b in sorted(motions, key=lambda one: -one[0]):
            if motion in self._free:
                continue
            if stop():
                return False
            self.checked, self.motion = self.checked + 1, motion
            if not free(a[None], b[None])[0]:
                self.block(motion)
                return False
            self._free.add(motion)
        return True
