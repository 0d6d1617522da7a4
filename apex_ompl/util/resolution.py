"""Spacings at which paths are judged."""

SEARCH_RESOLUTION = 0.031
"""Spacing of states that planners check along a motion [rad, max-norm]."""

FULL_RESOLUTION = 0.0031
"""Spacing of states of the full check, which decides whether a path is a solution [rad, max-norm]."""

MOTION_RESOLUTION = FULL_RESOLUTION / 10.0
"""Spacing of states of the full check of a timed motion [rad, max-norm]; a path that touches an obstacle between the
states of its own check is found by it."""
