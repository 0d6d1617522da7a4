"""Searches of paths in compiled code: trees that grow towards each other, shortcuts, and shortest paths in graphs.

What the spheres do not prove free counts as blocked.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel.compiled.check.motion_proof import OPEN_STATES, PROVED_INTERVALS, PROVED_STATES, TRIED_INTERVALS
from apex_ompl.kernel.compiled.layout import Integers
from apex_ompl.kernel.compiled.path.search import grow_trees
from apex_ompl.kernel.compiled.path.search import shortest_path as compiled_shortest_path
from apex_ompl.kernel.compiled.path.shortcutting import shortcut_path
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.types import Array
from apex_ompl.util.arrays import length, narrowed

AT_ONCE = 256  # random states between two looks at the clock, where steps are 1 rad and longer
LEAST_STEP = 0.01  # least longest step: one random state may cost as many as there are across the limits [rad]
ROOM = 1024  # first number of nodes of a tree
NEAR = 0.5  # share of random states that lie around a straight line between a start and a goal
SPREAD = 2.0  # standard deviation of these from the line, at most [rad]
GUIDED = 0.4  # share of all random states that lie around guides, where there are any
GUIDE_SPREAD = 1.0  # standard deviation of these from the guides, at most [rad]
TRIES, DRAWS = 64, 16  # motions between corners, and draws, between two looks at the clock
ENOUGH = 100  # draws for a path of trees
RESOLUTION = 0.01  # of the states along shortcuts of such a path [rad, max-norm]


class SearchCounts(NamedTuple):
    """Counts of a search.

    Attributes:
        proved: States that were proved free.
        blocked: States that were not, and count as blocked.
        intervals: Intervals of motions that were tried as a whole.
        proved_intervals: Those that were proved.
    """

    proved: int
    blocked: int
    intervals: int
    proved_intervals: int


class SearchBuffers:
    """Buffers for proofs of straight motions, see :func:`apex_ompl.kernel.compiled.check.motion_proof.prove_path`.

    Attributes:
        workspace: Workspace of the robot.
        proof: Motion, its grid, queue, ends, state, pairs and counts, as compiled code takes them.
    """

    def __init__(self, kernel: Kernel, longest: float, resolution: float) -> None:
        """Allocate buffers for motions up to ``longest`` [rad, max-norm] with states ``resolution`` apart [rad]."""
        dof, steps = kernel.robot.dof, math.ceil(longest / resolution) + 1
        self.workspace = kernel.workspace()
        self._counts: NDArray[np.int64] = np.zeros(5, np.int64)
        self.proof: tuple[Array | NDArray[Any], ...] = (
            np.empty((2, dof)), np.empty(2, np.int64), np.empty((2 * steps + 4, 2), np.int64), np.empty(3, np.int64),
            np.empty(dof), np.empty((1, 2), np.int64), self._counts,
        )  # fmt: skip

    def take_counts(self) -> SearchCounts:
        """Return the counts since the last call."""
        c = self._counts.tolist()
        self._counts[:] = 0
        return SearchCounts(c[PROVED_STATES], c[OPEN_STATES], c[TRIED_INTERVALS], c[PROVED_INTERVALS])


def _draw_range(kernel: Kernel, roots: Array) -> tuple[Array, Array]:
    """Return the limits, of continuous joints half a turn beyond the roots, shape (N, dof), at most."""
    limits = kernel.robot.arrays
    low, high = roots.min(axis=0, initial=np.inf) - math.pi, roots.max(axis=0, initial=-np.inf) + math.pi
    return narrowed((limits.lower, limits.upper), limits.continuous != 0, low, high)


class TreePair:
    """RRT-Connect on what a kernel proves, from some starts to some goals; it goes on where it stopped.

    A share NEAR of the random states is normally distributed around straight lines from starts to goals; the others are
    uniform in the limits, of continuous joints half a turn beyond starts and goals. Where there are guides, states of
    paths that are nearly free, as of a model's proposals, a share GUIDED of all is normally distributed around these
    instead (after Ichter, Harrison and Pavone 2018). Distances are Euclidean, with joints weighed.
    States that the kernel cannot prove free count as blocked (:mod:`apex_ompl.kernel.compiled.path.search`).
    """

    def __init__(
        self, kernel: Kernel, starts: Array, goals: Array, longest: float, resolution: float, rng: np.random.Generator
    ) -> None:  # fmt: skip
        """Plant the trees.

        Args:
            kernel: The robot among its obstacles, with the limits of the states.
            starts: Roots of one tree, shape (N, dof); they are taken to be free.
            goals: Roots of the other, shape (N, dof).
            longest: Longest step; one below LEAST_STEP counts as that [rad].
            resolution: Largest spacing of the states that are checked along a step [rad, max-norm].
            rng: Source of the random states.
        """
        self._lower, self._upper = _draw_range(kernel, np.concatenate([starts, goals]))
        weight = kernel.robot.arrays.weight
        longest = min(max(longest, LEAST_STEP), length((self._upper - self._lower) * weight))  # no step is longer
        self._kernel, self._longest, self._resolution = kernel, longest, resolution
        self._at_once = max(int(AT_ONCE * min(longest, 1.0)), 1)  # short steps are many for each random state
        dof, most = kernel.robot.dof, max(len(starts), len(goals))
        self._starts, self._goals = starts, goals
        self._rng, (self._normal_rng, *self._guide_rngs) = rng, rng.spawn(3)
        self._guides = np.empty((0, dof))
        self._sizes = np.array([len(starts), len(goals), 0], np.int64)
        room = max(ROOM, 2 * most)
        self._states, self._parents = np.zeros((2, dof, room)), np.full((2, room), -1, np.int64)
        for tree, roots in enumerate((starts, goals)):
            self._states[tree, :, : len(roots)] = roots.T
        self._buffers = SearchBuffers(kernel, longest, resolution)
        self._met, self._target = np.full(2, -1, np.int64), np.empty(dof)
        self._failed = 0  # steps

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(self._sizes[:2].sum())

    def nodes(self, tree: int) -> tuple[Array, NDArray[np.int64]]:
        """Return the states of tree 0, from the starts, or 1, from the goals, and the parent of each, -1 for roots."""
        count = int(self._sizes[tree])
        return np.ascontiguousarray(self._states[tree, :, :count].T), self._parents[tree, :count].copy()

    @property
    def steps(self) -> int:
        """Number of steps that were tried: each random state ends with one that fails, but where the trees meet."""
        return self.size - len(self._starts) - len(self._goals) + self._failed

    def take_counts(self) -> SearchCounts:
        """Return the counts since the last call."""
        return self._buffers.take_counts()

    def guide(self, states: Array) -> None:
        """Draw some of the random states around these from now on, shape (N, dof); around none where N is 0."""
        self._guides = states

    def grow(self, iterations: int, stop: Callable[[], bool] = lambda: False) -> Array | None:
        """Return a path from a start to a goal, shape (N, dof), or None where the trees did not meet.

        Args:
            iterations: Number of random states.
            stop: Asked from time to time whether to give up.
        """
        while iterations > 0 and not stop():
            samples = self._random_states(min(iterations, self._at_once))
            iterations -= len(samples)
            while len(samples) and not stop():
                used = self._advance(samples)
                self._failed += used - int(self._met[0] >= 0)
                if self._met[0] >= 0:
                    return self._path()
                samples = samples[used:]
                if len(samples):
                    self._make_room()
        return None

    def _advance(self, samples: Array) -> int:
        """Let the trees grow by random states, shape (N, dof); return how many were used."""
        return int(grow_trees(*self._arguments(samples)))

    def _arguments(self, samples: Array) -> tuple[Any, ...]:
        return (
            *self._kernel.packed, *self._buffers.workspace, samples, self._longest, self._resolution,
            self._states, self._parents, self._sizes, self._met, np.empty(self._states.shape[2]), self._target,
            *self._buffers.proof,
        )  # fmt: skip

    def _random_states(self, count: int) -> Array:
        """Return states of which some are uniform in the limits, and some lie around lines from starts to goals.

        They are the same however many are drawn at once.
        """
        (lower, upper), dof = (self._lower, self._upper), self._starts.shape[1]
        share, normal = self._rng.random((count, dof + 5)), self._normal_rng.standard_normal((count, dof))
        states = lower + share[:, :dof] * (upper - lower)
        near = np.flatnonzero(share[:, dof] < NEAR)
        which, along, spread = share[near, dof + 1 : dof + 3], share[near, dof + 3, None], share[near, dof + 4, None]
        starts = self._starts[(which[:, 0] * len(self._starts)).astype(int)]
        goals = self._goals[(which[:, 1] * len(self._goals)).astype(int)]
        around = starts + along * (goals - starts) + SPREAD * spread * normal[near] / self._kernel.robot.arrays.weight
        states[near] = np.clip(around, lower, upper)
        if len(self._guides):
            self._move_to_guides(states)
        return states

    def _move_to_guides(self, states: Array) -> None:
        """Put a share GUIDED of random states around guides."""
        count, dof = states.shape
        draws, normal = self._guide_rngs[0].random((count, 3)), self._guide_rngs[1].standard_normal((count, dof))
        some = np.flatnonzero(draws[:, 0] < GUIDED)
        chosen = self._guides[(draws[some, 1] * len(self._guides)).astype(int)]
        apart = GUIDE_SPREAD * draws[some, 2, None] * normal[some] / self._kernel.robot.arrays.weight
        states[some] = np.clip(chosen + apart, self._lower, self._upper)

    def _make_room(self) -> None:
        self._states = np.ascontiguousarray(np.concatenate([self._states, np.zeros_like(self._states)], axis=2))
        self._parents = np.ascontiguousarray(np.concatenate([self._parents, np.full_like(self._parents, -1)], axis=1))

    def _path(self) -> Array:
        """Return the path through the nodes at which the trees met."""
        halves = []
        for tree in range(2):
            node, nodes = int(self._met[tree]), list[int]()
            while node >= 0:
                nodes.append(node)
                node = int(self._parents[tree, node])
            halves.append(self._states[tree][:, nodes].T)
        return np.ascontiguousarray(np.concatenate([halves[0][::-1], halves[1][1:]]))


def shortcut(
    kernel: Kernel, path: Array, draws: int, resolution: float, rng: np.random.Generator,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[Array, SearchCounts]:  # fmt: skip
    """Return a path with the same ends that is no longer, and the counts of the search.

    First as many corners as possible are left out, then straight motions between two random places along the path take
    the place of what is between them, where the kernel proves them free (Geraerts and Overmars, 2007), and corners are
    left out again.

    Args:
        kernel: The robot among its obstacles.
        path: Corners of the path, shape (N, dof).
        draws: Number of random shortcuts that are tried.
        resolution: Largest spacing of the states that are checked along them [rad, max-norm].
        rng: Source of the places.
        stop: Asked from time to time whether to leave it as it is by then.
    """
    states = kernel.states(path)
    extent = float(np.ptp(states, axis=0).max(initial=0.0))
    buffers = SearchBuffers(kernel, max(extent, resolution), resolution)
    room = np.concatenate([states, np.zeros((len(states) + 16, states.shape[1]))])
    progress, places = np.array([len(states), 0, TRIES]), rng.random((draws, 2))

    def advance(some: Array) -> None:
        shortcut_path(*kernel.packed, *buffers.workspace, some, float(resolution), room, progress, *buffers.proof)

    def leave_out() -> None:
        progress[1] = 0
        while progress[1] < progress[0] - 2 and not stop():
            advance(places[:0])

    leave_out()
    for first in range(0, draws, DRAWS):
        if stop():
            break
        advance(places[first : first + DRAWS])
    leave_out()
    count = int(progress[0])
    short = np.concatenate([states[:1], room[1 : count - 1], states[-1:]]) if count > 1 else states
    return short, buffers.take_counts()


class Graph(NamedTuple):
    """A directed graph of N nodes and E edges, sorted by the node that they start at.

    Attributes:
        first: First edge of each node, shape (N + 1,).
        ends: Node that each edge leads to, shape (E,).
        lengths: Length of each edge, shape (E,) [rad].
    """

    first: Integers
    ends: Integers
    lengths: Array


class GraphSearch:
    """Shortest paths in a graph by A* (Hart, Nilsson and Raphael 1968), from a start over the graph to a goal.

    Attributes:
        cost: Length of the shortest path to each node after a search, shape (N,); infinite where it was not reached.
        parent: Edge by which each node was reached, shape (N,); -1 from the start.
    """

    def __init__(self, graph: Graph) -> None:
        """Allocate buffers for searches of a graph."""
        nodes, edges = len(graph.first) - 1, len(graph.ends)
        self.graph = graph
        self.cost, self.parent = np.empty(nodes), np.empty(nodes, np.int64)
        self._queue = np.empty(nodes + edges), np.empty(nodes + edges, np.int64)

    def last_node(self, usable: Integers, entry: Array, leave: Array, heuristic: Array) -> int:
        """Return the last node of a shortest path, or -1 without one.

        Args:
            usable: 0 for edges that may not be used, shape (E,).
            entry: Distance from the start to each node, shape (N,); infinite where there is no motion.
            leave: Distance from each node to a goal, shape (N,); infinite where there is no motion.
            heuristic: Consistent lower bound on the distance to a goal, shape (N,).
        """
        return int(
            compiled_shortest_path(*self.graph, usable, entry, leave, heuristic, self.cost, self.parent, *self._queue)
        )
