"""Resolutions of collision checking along paths."""

SEARCH_RESOLUTION = 0.031
"""Largest spacing of the states that planners check along a motion [rad, max-norm]."""

FINE_RESOLUTION = 0.0031
"""Largest spacing of the states at which the kernel alone, without exact shapes, checks paths: training data and the
validation of models [rad, max-norm]. What counts as a solution is decided by a proof without any spacing."""
