"""One replan under way, and where motions to start from come from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from apex_ompl.live.timed_spline import MotionOptimizer, MotionSettings, Start
from apex_ompl.loop.charges import Charges
from apex_ompl.loop.following import Following
from apex_ompl.loop.motion_pool import MotionPool
from apex_ompl.loop.ready import Ready
from apex_ompl.loop.request import Request
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory import Trajectory
from apex_ompl.types import Array

MOTIONS = MotionSettings(samples=2)
STATES = 64  # of a motion that splines begin from
BETTER = 0.97  # share of the duration of the best motion so far below which another one is worth its while


@dataclass(eq=False)
class Search:
    """One replan under way: what its parts share.

    Attributes:
        ready: The robot among what stands still.
        request: What is asked for.
        charges: What was spent.
        start: What the robot does when the motion begins.
        rng: Source of random choices.
        best: The best motion so far, or None.
        part: What found it.
    """

    ready: Ready
    request: Request
    charges: Charges
    start: Start = field(init=False)
    rng: np.random.Generator = field(init=False)
    best: Following | None = None
    part: str = ""

    def __post_init__(self) -> None:
        """Read the request."""
        self.start, self.rng = self.request.following.start(self.request.join), self.request.rng

    @property
    def goals(self) -> Array:
        """Goals, shape (goals, dof), the nearest first."""
        goals = self.ready.goals
        order: Array = goals[np.argsort(np.linalg.norm(goals - self.start.position, axis=1), kind="stable")]
        return order

    def wanted(self) -> float:
        """Return the duration that a motion must be shorter than to be of use [s]."""
        return np.inf if self.best is None else BETTER * self.best.motion.duration

    def following(self, motion: Trajectory) -> Following:
        """Return a motion as one that is followed from the time of joining on."""
        return Following(motion, self.request.join, self.ready.is_goal(motion.positions[-1]))

    def accepts(self, motion: Trajectory) -> bool:
        """Whether a motion is proved, with the time that its end must stay clear."""
        one, settings = self.following(motion), self.ready.settings
        until = one.end + (settings.hold if one.to_goal else settings.rest_hold)
        conflict = self.ready.first_conflict(self.request.predicted, one, one.begin, until, self.charges)
        return not np.isfinite(conflict) and self.ready.clear_of_still(motion, self.charges)

    def take(self, motion: Trajectory, part: str) -> None:
        """Keep a proved motion where it is shorter than the best."""
        if motion.duration < self.wanted():
            self.best, self.part = self.following(motion), part

    def pool(self, berth: bool = True) -> MotionPool:
        """Return an empty pool of motions, which are optimised with a berth around obstacles or without."""
        request, ready = self.request, self.ready
        movers = request.wide if berth else request.predicted
        optimizer = MotionOptimizer(ready.kernel, movers, ready.limits, MOTIONS)
        beyond = ready.settings.berth if berth else 0.0
        return MotionPool(optimizer, self.start, request.join, self.charges, self.accepts, berth=beyond)


class Guess(NamedTuple):
    """A motion to start from.

    Attributes:
        states: States evenly spaced in time, shape (N, dof).
        goal: Where it ends, shape (dof,).
        duration: About how long it takes without obstacles [s].
    """

    states: Array
    goal: Array
    duration: float


class Source(Protocol):
    """Where motions to start from come from."""

    @property
    def name(self) -> str:
        """Its name."""

    def prepare(self, ready: Ready) -> None:
        """Load what it needs, before a run."""

    def guesses(self, search: Search) -> Iterator[Guess]:
        """Yield motions to start from, and charge what they cost."""


def least_duration(states: Array, limits: Limits) -> float:
    """Return about how long a motion along states takes at least, shape (N, dof) [s]."""
    way = np.abs(np.diff(states, axis=0)).sum(axis=0)
    distance = np.abs(states[-1] - states[0]) / limits.acceleration
    return float(max((way / limits.velocity).max(), 2.0 * np.sqrt(distance.max()), 0.1))
