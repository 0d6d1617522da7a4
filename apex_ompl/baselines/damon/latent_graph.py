"""DAMON's graph: nodes spread over a latent space of states, joined to their neighbors where the robot allows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from apex_ompl.baselines.damon.lazy_search import Graph, LazySearch
from apex_ompl.baselines.damon.manifold import Manifold, StateAutoencoder
from apex_ompl.kernel import Kernel
from apex_ompl.robot.model import TURN, Robot
from apex_ompl.types import Array, Flags, Indices

POOL = 5  # times as many nodes are nearest in the latent space as are joined: those of them nearest in joint space
SPACING = 0.05  # of the states at which edges are checked for self-collision [rad, max-norm]
BLOCK = 512  # nodes whose distances are computed at once
WIDER = 3  # factor on the number of connections where they lead to no path


@dataclass(frozen=True, eq=False)
class StateSample:
    """States of paths that are known to be valid.

    Attributes:
        states: Shape (N, J) [rad].
        paths: Number of the path of each, shape (N,), in order; those of one path are in their order along it.
    """

    states: Array
    paths: Indices


def farthest_points(points: Array, count: int, first: int = 0) -> Indices:
    """Return points each of which is the farthest from those before it (Gonzalez 1985), shape (count,).

    No two of them are nearer to each other than any point is to the nearest of them.

    Args:
        points: Shape (N, d).
        count: At most N.
        first: Number of the first point.
    """
    found = np.empty(count, np.int64)
    columns = np.ascontiguousarray(points.T, np.float32)
    away = np.full(points.shape[0], np.inf, np.float32)
    k = first
    for n in range(count):
        found[n] = k
        squares = np.square(columns[0] - columns[0, k])
        for column in columns[1:]:
            squares += np.square(column - column[k])
        np.minimum(away, squares, out=away)
        k = int(np.argmax(away))
    return found


def nearest_nodes(latent: Array, states: Array, z: Array, q: Array, count: int) -> Indices:
    """Return the nodes nearest to a state in joint space among those nearest in latent space, the nearest first.

    Args:
        latent: Latent vectors of the nodes, shape (N, d).
        states: States of the nodes, shape (N, J).
        z: Latent vector, shape (d,).
        q: State, shape (J,).
        count: Number of nodes that are wanted; :data:`POOL` times as many are nearest in latent space.
    """
    away = np.square(latent - z).sum(axis=1)
    pool = min(POOL * count, len(latent))
    near = np.argpartition(away, pool - 1)[:pool]
    order = np.argsort(np.linalg.norm(states[near] - q, axis=1), kind="stable")
    return near[order[:count]]


def neighbors(latent: Array, states: Array, count: int) -> Indices:
    """Return the nearest nodes of each node as :func:`nearest_nodes` does, itself left out, shape (N, count)."""
    found = np.empty((len(latent), count), np.int64)
    squares, pool = np.square(latent).sum(axis=1), min(POOL * count + 1, len(latent))
    for k in range(0, len(latent), BLOCK):
        rows = np.arange(k, min(k + BLOCK, len(latent)))
        away = squares - 2.0 * (latent[rows] @ latent.T)
        near = np.argpartition(away, pool - 1, axis=1)[:, :pool]
        length = np.linalg.norm(states[near] - states[rows, None], axis=2)
        length[near == rows[:, None]] = np.inf
        order = np.argsort(length, axis=1, kind="stable")[:, :count]
        found[rows] = np.take_along_axis(near, order, axis=1)
    return found


def free_of_self_collision(kernel: Kernel, first: Array, last: Array) -> Flags:
    """Return whether the sphere cover proves straight motions free of self-collision, at states along them, shape (M,).

    Args:
        kernel: The robot.
        first: States that they start at, shape (M, dof).
        last: States that they end at, shape (M, dof).
    """
    found = np.ones(len(first), bool)
    counts = np.ceil(np.abs(last - first).max(axis=1) / SPACING).astype(int) + 1
    for count in np.unique(counts):
        which = np.flatnonzero(counts == count)
        for some in np.array_split(which, max(1, len(which) * count // 100_000)):
            shares = np.linspace(0.0, 1.0, count)[:, None]
            states = first[some, None] + shares * (last - first)[some, None]
            clear = kernel.clearance(states.reshape(-1, states.shape[2]), 0.01)[:, 1] > 0.0
            found[some] = np.all(clear.reshape(len(some), count), axis=1)
    return found


def consecutive(paths: Indices) -> Indices:
    """Return pairs of nodes that follow each other along a path, shape (M, 2).

    Args:
        paths: Number of the path of each node, shape (N,), the nodes in their order along paths.
    """
    k = np.flatnonzero(paths[1:] == paths[:-1])
    return np.stack([k, k + 1], axis=1)


def edges(
    latent: Array, states: Array, count: int, *, kernel: Kernel, whole: Array, joints: Indices
) -> Indices:  # fmt: skip
    """Return the pairs of neighbors whose straight motion is free of self-collision, the smaller number first.

    Args:
        latent: Latent vectors of the nodes, shape (N, d).
        states: Their states, shape (N, J).
        count: Number of neighbors of a node.
        kernel: The robot.
        whole: A state of all joints, shape (dof,), for those that the graph has no values of.
        joints: Which joints the graph has values of, shape (J,).

    Returns:
        Shape (M, 2).
    """
    near = neighbors(latent, states, count)
    pairs = np.stack([np.repeat(np.arange(len(latent)), near.shape[1]), near.ravel()], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    full = np.repeat(whole[None], len(states), axis=0)
    full[:, joints] = states
    free = free_of_self_collision(kernel, full[pairs[:, 0]], full[pairs[:, 1]])
    found: Indices = pairs[free]
    return found


def chosen_nodes(sample: StateSample, autoencoder: StateAutoencoder, count: int) -> Indices:
    """Return states of a sample that are spread evenly over the latent space, in the order of the sample, (count,)."""
    latent = autoencoder.encode(sample.states)
    return np.sort(farthest_points(latent, min(count, len(latent))))


@dataclass(frozen=True, eq=False)
class Damon:
    """DAMON (arXiv 2203.13282, IROS 2023): planning on a low-dimensional manifold of the states of safe motions.

    A variational autoencoder learns the manifold from the states of valid paths. Offline, nodes are spread over it and
    joined to their neighbors; online, those that obstacles hit are left out, and A* finds a path over the rest.

    It is reimplemented from the abstract, and from abstracts of the authors' other papers: the method's section was not
    at hand. These leave open, and here it is: the network (J -> 64 -> 64 -> d with SiLU, trained on joint angles scaled
    by their limits); how nodes are spread (farthest-point sampling of the latent vectors of the training states);
    neighbors (of the five times as many nodes that are nearest in the latent space the 12 nearest in joint space, as
    far as a sphere cover proves the straight motion between free of self-collision, and nodes that follow each other
    along a training path); lengths (Euclidean, in joint space); when edges are checked (where the shortest path uses
    one, as in lazy PRM; nodes, too, that spheres neither prove free nor see deep in contact); how a start and a goal
    that are not on the manifold are reached (by straight motions from the nearest nodes, chosen as neighbors are);
    hands (no part of the manifold; they stay as at the start until the last motion).

    Attributes:
        manifold: The manifold.
        kind: ``decoded``, or ``stored``, for nodes that are training states: not the paper's, but more generous.
        graph: The graph of its nodes of that kind.
        joints: Which joints of the robot it has values of, shape (J,).
        endless: Which of these turn without end, shape (J,): the graph is turned to a start by whole turns of them.
        connections: Number of nodes over which paths may leave each start, and reach each goal, at first; three times
            as many each time that these lead to no path.
    """

    manifold: Manifold
    kind: str
    graph: Graph
    joints: Indices
    endless: Flags
    connections: int

    @classmethod
    def of(cls, manifold: Manifold, robot: Robot, kind: str, connections: int) -> Damon:
        """Return queries of a manifold for its robot."""
        joints = np.array([robot.joint_names.index(name) for name in manifold.config.joints])
        return cls(manifold, kind, manifold.graph(kind), joints, robot.continuous[joints], connections)

    def states(self, start: Array) -> Array:
        """Return the states of the nodes, shape (N, dof); other joints are as at a start, shape (dof,)."""
        states = np.repeat(start[None], len(self.graph.states), axis=0)
        states[:, self.joints] = self.graph.states + self._turns(start)
        return states

    def _turns(self, q: Array) -> Array:
        """Return the whole turns of a state, shape (dof,), from the graph's range, shape (J,) [rad]."""
        return np.where(self.endless, TURN * np.rint(q[self.joints] / TURN), 0.0)

    def search(
        self, states: Array, usable: Flags, starts: Array, goals: Array, *, free_nodes: Flags | None = None
    ) -> LazySearch:  # fmt: skip
        """Return a search for paths from starts to goals.

        Args:
            states: What :meth:`states` returned, shape (N, dof).
            usable: Which nodes may be used, shape (N,).
            starts: Shape (S, dof).
            goals: Shape (G, dof).
            free_nodes: Which nodes are known to be free, shape (N,); by default those that may be used.
        """
        search = LazySearch(replace(self.graph, states=states), usable, starts, goals, free_nodes=free_nodes)
        left, count, turns = np.flatnonzero(usable), 0, self._turns(starts[0])

        def connect() -> bool:
            """Connect the nearest nodes, and then three times as many each time, as long as there are more."""
            nonlocal count
            known, count = count, WIDER * count or self.connections
            if known >= len(left):
                return False
            latent, nodes = self.manifold.latent[left], states[left][:, self.joints]
            for rows, which in ((starts, "start"), (goals, "goal")):
                for k, q in enumerate(rows[:, self.joints]):
                    z = self.manifold.autoencoder.encode((q - turns)[None])[0]
                    near = nearest_nodes(latent, nodes, z, q, count)
                    if known:
                        near = np.setdiff1d(near, nearest_nodes(latent, nodes, z, q, known))
                    search.connect(**{which: k}, nodes=left[near])
            return True

        connect()
        search.more = connect
        return search
