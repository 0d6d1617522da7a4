"""Sources of motions that need no network."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from apex_ompl.moving.ready import Ready
from apex_ompl.moving.search import STATES, Guess, Search, least_duration
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.types import Array

FASTER = (0.92, 0.8)  # shares of the duration of a motion in which a faster one is looked for


@dataclass(frozen=True)
class Route:
    """What is left of the last motion to a goal."""

    name: str = "route"

    def prepare(self, ready: Ready) -> None:
        """Nothing is needed."""

    def guesses(self, search: Search) -> Iterator[Guess]:
        """Yield the rest of the route, where there is one."""
        rest = rest_of_route(search)
        if rest is not None:
            yield Guess(rest, rest[-1], least_duration(rest, search.ready.limits))


@dataclass(frozen=True)
class Faster:
    """The motion that is followed, faster."""

    name: str = "faster"

    def prepare(self, ready: Ready) -> None:
        """Nothing is needed."""

    def guesses(self, search: Search) -> Iterator[Guess]:
        """Yield the rest of the motion, where it has no conflict."""
        request = search.request
        left = request.following.end - request.join
        if request.hastens and left > 0.0:
            times = request.join - request.following.begin + np.linspace(0.0, left, STATES)
            states = request.following.motion(np.clip(times, 0.0, request.following.motion.duration))
            for factor in FASTER:
                yield Guess(states, request.following.motion.positions[-1], factor * left, timed=True)


@dataclass(frozen=True)
class Lines:
    """Straight lines to the nearest goals, and lines with bumps.

    Attributes:
        bumps: Number of lines with bumps for each goal; 0 takes the straight line alone.
        size: How far they stray [rad].
        goals: Number of goals.
    """

    bumps: int = 0
    size: float = 0.6
    goals: int = 2
    name: str = "line"

    def prepare(self, ready: Ready) -> None:
        """Nothing is needed."""

    def guesses(self, search: Search) -> Iterator[Guess]:
        """Yield the lines."""
        optimizer, fingers = Optimizer(), search.ready.fingers
        for goal in search.goals[: self.goals]:
            starts = optimizer.starts(search.start.position, goal, 1 + self.bumps, search.rng, self.size)
            starts[1:, :, fingers] = starts[0, :, fingers].T
            for control in starts[1:] if self.bumps else starts:
                states = optimizer.spline.path(control)
                yield Guess(states, goal, least_duration(states, search.ready.limits))


def rest_of_route(search: Search) -> Array | None:
    """Return states of what is left of the last motion to a goal, shape (N, dof), or None."""
    route = search.request.route
    if route is None:
        return None
    states = route.motion(np.linspace(0.0, route.motion.duration, 256))
    nearest = int(np.argmin(np.linalg.norm(states - search.start.position, axis=1)))
    rest = states[nearest:]
    if len(rest) < 2:
        return None
    wanted = np.linspace(0.0, len(rest) - 1.0, STATES)
    return np.stack([np.interp(wanted, np.arange(len(rest)), column) for column in rest.T], axis=1)
