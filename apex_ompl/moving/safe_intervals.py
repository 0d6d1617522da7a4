"""Intervals of time in which obstacles that move block places along a motion; what is left of time is safe there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.moving import blocked_intervals
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, curve_of
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array


class Blocked(NamedTuple):
    """Intervals of time in which places along a motion are blocked.

    Attributes:
        places: Begins and ends of the places, in the motion's own time, shape (P, 2) [s].
        spans: Their intervals in order, shape (P, most, 2) [s of the dynamic obstacles' stamps].
        counts: Numbers of them, shape (P,).
    """

    places: Array
    spans: Array
    counts: NDArray[np.int64]

    def longer(self, by: float) -> Array:
        """Return the intervals, longer at both ends [s]."""
        longer: Array = self.spans + np.array([-by, by])
        return longer

    def meets(self, place: int, first: float, last: float) -> bool:
        """Whether a place is blocked at any time between two [s]."""
        spans = self.spans[place, : self.counts[place]]
        return bool(np.any((spans[:, 0] <= last) & (spans[:, 1] >= first)))


def blocked(
    kernel: Kernel,
    dynamic: DynamicObstacles,
    motion: Trajectory,
    places: Array,
    *,
    begin: float,
    end: float,
    slack: float = 0.0,
) -> Blocked:
    """Find when dynamic obstacles block places along a motion, by the robot's spheres: never too short.

    Args:
        kernel: The kernel of the robot with what it holds.
        dynamic: The obstacles.
        motion: The motion.
        places: Begins and ends of pieces of the motion, in its own time and in order, shape (P, 2) [s]; the same twice
            for a single state.
        begin: First time that is looked at [s of the dynamic obstacles' stamps].
        end: The last one [s].
        slack: Distance from the path, of each joint, that counts as being on it [rad].
    """
    return Blocked(places, *blocked_intervals(kernel, dynamic.packed, curve_of(motion), places, (begin, end), slack))
