"""DAMON: A* over a graph on a learned manifold of states."""
