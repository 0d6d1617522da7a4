"""Faster motions through states of a given one."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from apex_ompl.moving.search import Search
from apex_ompl.timing import Trajectory
from apex_ompl.timing.ruckig_method import through

TRIES = ((2, 1.25), (3, 1.25), (2, 1.0), (4, 1.1), (3, 1.0))  # numbers of pieces, and factors on the speed between them
SHARE = 0.98  # of the limits that speeds and accelerations between pieces have at most


def quickened(search: Search, motion: Trajectory) -> Iterator[Trajectory]:
    """Yield faster motions through states of a motion, which begins when the robot joins it and ends at rest.

    Each is in a few pieces, the fastest between their states by Ruckig (Berscheid and Kroeger 2021). Splines cannot
    change their acceleration as quickly as the limits of jerk allow.

    Args:
        search: The replan under way.
        motion: The motion.
    """
    limits, names, duration = search.ready.limits, search.ready.names, motion.duration
    solve = partial(search.charges.charge, "piece of a motion")
    for pieces, factor in TRIES:
        if search.over() or duration <= 0.0:
            return
        states = motion.states(np.linspace(0.0, duration, pieces + 1))
        for order, most in ((1, limits.velocity), (2, limits.acceleration)):
            states[order] = np.clip(factor**order * states[order], -SHARE * most, SHARE * most)
        states[:, 0], states[:, -1] = search.start, (motion.positions[-1], 0.0 * most, 0.0 * most)
        faster = through(states, limits, names, search.wanted(), solve)
        if faster is not None and faster.duration > 0.0:
            search.charges.charge("joined motion")
            yield faster
