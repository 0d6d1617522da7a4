"""Trajectory optimisation: B-spline paths, the optimiser, the candidate pool."""
