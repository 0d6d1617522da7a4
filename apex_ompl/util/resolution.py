"""Resolutions of collision checking along paths."""

SEARCH_RESOLUTION = 0.031
"""Largest spacing of the states that planners check along a motion [rad, max-norm]."""

FULL_RESOLUTION = 0.0031
"""Largest spacing of the states of the full check, which decides whether a path is a solution [rad, max-norm]."""
