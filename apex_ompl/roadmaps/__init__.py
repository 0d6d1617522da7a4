"""Trees and graphs of states that planners keep: the tree of dynamic RRT, and the graph of DAMON on a latent manifold.

No OMPL and no Pinocchio; torch for training alone.
"""
