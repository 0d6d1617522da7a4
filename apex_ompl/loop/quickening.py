"""Faster motions through states of a given one."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from apex_ompl.loop.search import Search
from apex_ompl.trajectory import Trajectory
from apex_ompl.trajectory.methods.moving_start import between
from apex_ompl.trajectory.trajectory import concatenate

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
    for pieces, factor in TRIES:
        if search.over() or duration <= 0.0:
            return
        states = np.stack([motion(np.linspace(0.0, duration, pieces + 1), order) for order in range(3)])
        for order, most in ((1, limits.velocity), (2, limits.acceleration)):
            states[order] = np.clip(factor**order * states[order], -SHARE * most, SHARE * most)
        states[:, 0], states[:, -1] = search.start, (motion.positions[-1], 0.0 * most, 0.0 * most)
        found, left = [], search.wanted()
        for k in range(pieces):
            search.charges.charge("direct motion")
            one = between(states[:, k : k + 2], limits, names)
            if one is None or one.duration >= left:
                break
            found.append(one)
            left -= one.duration
        else:
            yield concatenate([one for one in found if one.duration > 0.0])
