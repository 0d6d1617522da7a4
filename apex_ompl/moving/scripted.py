"""Obstacles along their scripts: pieces of time in which all of them move at constant velocity."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles, allowed_rows, clearance_in_time
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import is_there, obstacle_at, place_at, script_times, velocity_at
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array


class Piece(NamedTuple):
    """A piece of time in which all obstacles move at constant velocity.

    Attributes:
        begin: Its begin [s].
        end: Its end [s].
        dynamic: The obstacles that are there, with ``begin`` as their stamp; good until the next piece is asked for.
    """

    begin: float
    end: float
    dynamic: DynamicObstacles


class ScriptedDynamicObstacles:
    """Obstacles that move by scripts, beside a kernel's scene.

    Attributes:
        kernel: The kernel of the robot with what it holds.
        obstacles: The obstacles with their scripts.
    """

    def __init__(self, kernel: Kernel, obstacles: Iterable[Obstacle], allowed: Sequence[tuple[str, str]] = ()) -> None:
        """Take obstacles, and pairs of names of bodies that may touch.

        Raises:
            SceneError, ParameterError: As :class:`apex_ompl.moving.dynamic_obstacles.DynamicObstacles`.
        """
        self.kernel, self.obstacles, self._allowed = kernel, tuple(obstacles), tuple(allowed)
        self._known: dict[tuple[str, ...], DynamicObstacles] = {}
        self._dynamic(self.obstacles, 0.0)

    def pieces(self, end: float) -> Iterator[Piece]:
        """Yield the pieces of the time from 0 to ``end`` [s] in turn; a single one without length where that is 0."""
        inner = {time for o in self.obstacles for time in script_times(o) if 0.0 < time < end}
        edges = [0.0, *sorted(inner), end]
        for begin, until in zip(edges[:-1], edges[1:], strict=True):
            here = [o for o in self.obstacles if is_there(o, begin)]
            yield Piece(begin, until, self._dynamic(here, begin))

    def clearances(self, motion: Trajectory, times: Array) -> Array:
        """Return lower bounds of a motion's distance to the obstacles at some times, shape (N,) [m].

        They are distances of the sphere cover, which contains the robot; infinite where there is no obstacle, NaN where
        a hand is outside its limits.

        Args:
            motion: The motion; behind its end the robot stands.
            times: Shape (N,), increasing from 0 or more [s].
        """
        found = np.full(len(times), np.inf)
        for begin, end, dynamic in self.pieces(float(times[-1]) if len(times) else 0.0):
            rows = np.flatnonzero((times >= begin) & (times <= end))
            if len(dynamic) and len(rows):
                at = times[rows]
                found[rows] = clearance_in_time(self.kernel, dynamic, motion(at), at)[0]
        return found

    def _dynamic(self, here: Sequence[Obstacle], time: float) -> DynamicObstacles:
        """Return obstacles as they are from a time on [s]."""
        names = tuple(o.name for o in here)
        if names not in self._known:
            rows = allowed_rows(self.kernel, self._allowed, names)
            self._known[names] = DynamicObstacles([obstacle_at(o, time) for o in here], rows)
        dynamic = self._known[names]
        for o in here:
            dynamic.update(o.name, place_at(o, time), velocity_at(o, time), stamp=time)
        return dynamic
