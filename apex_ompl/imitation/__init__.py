"""Imitation learning: a transformer policy that is trained on stored paths, a baseline of the paper.

It knows torch, NumPy, the kernel and data sets; no OMPL and no Pinocchio.
"""
