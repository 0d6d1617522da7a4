"""Queries of DAMON's graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from apex_ompl.baselines.damon.latent_graph import nearest_nodes
from apex_ompl.baselines.damon.lazy_search import Graph, LazySearch
from apex_ompl.baselines.damon.manifold import Manifold
from apex_ompl.types import Array, Flags, Indices

WIDER = 3  # factor on the number of connections where they lead to no path


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
        connections: Number of nodes over which paths may leave each start, and reach each goal, at first; three times
            as many each time that these lead to no path.
    """

    manifold: Manifold
    kind: str
    graph: Graph
    joints: Indices
    connections: int

    @classmethod
    def of(cls, manifold: Manifold, names: Sequence[str], kind: str, connections: int) -> Damon:
        """Return queries of a manifold, for a robot with joints of given names."""
        joints = np.array([list(names).index(name) for name in manifold.config.joints])
        return cls(manifold, kind, manifold.graph(kind), joints, connections)

    def states(self, start: Array) -> Array:
        """Return the states of the nodes, shape (N, dof); other joints are as at a start, shape (dof,)."""
        states = np.repeat(start[None], len(self.graph.states), axis=0)
        states[:, self.joints] = self.graph.states
        return states

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
        left, count = np.flatnonzero(usable), 0

        def connect() -> bool:
            """Connect the nearest nodes, and then three times as many each time, as long as there are more."""
            nonlocal count
            known, count = count, WIDER * count or self.connections
            if known >= len(left):
                return False
            latent, nodes = self.manifold.latent[left], self.graph.states[left]
            for rows, which in ((starts, "start"), (goals, "goal")):
                for k, q in enumerate(rows[:, self.joints]):
                    z = self.manifold.autoencoder.encode(q[None])[0]
                    near = nearest_nodes(latent, nodes, z, q, count)
                    if known:
                        near = np.setdiff1d(near, nearest_nodes(latent, nodes, z, q, known))
                    search.connect(**{which: k}, nodes=left[near])
            return True

        connect()
        search.more = connect
        return search
