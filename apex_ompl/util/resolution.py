"""Resolutions of collision checking along paths."""

SEARCH_RESOLUTION = 0.031
"""Largest spacing of the states that planners check along a motion [rad, max-norm]."""

FULL_RESOLUTION = 0.0031
"""Largest spacing of the states of the full check, which decides whether a path is a solution [rad, max-norm]."""

MOTION_RESOLUTION = FULL_RESOLUTION / 10.0
"""Largest spacing of the states of a timed motion's check [rad, max-norm]; it finds paths that touch an obstacle
between the states of their own full check."""
