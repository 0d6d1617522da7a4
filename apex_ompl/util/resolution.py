"""Spacings at which paths are judged."""

SEARCH_RESOLUTION = 0.031
"""Spacing of states that planners check along a motion [rad, max-norm]."""

FULL_RESOLUTION = 0.0031
"""Spacing of states of the full check, which decides whether a path is a solution [rad, max-norm]."""
