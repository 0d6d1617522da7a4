"""A run on the simulated clock: a world that moves on by steps, and a robot that follows exactly what it is told."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from apex_ompl.live.movers import Movers
from apex_ompl.loop.executor import Executor
from apex_ompl.loop.following import Following, executed
from apex_ompl.loop.observation import Observation
from apex_ompl.loop.ready import Ready
from apex_ompl.loop.request import Replanner
from apex_ompl.loop.result import Event
from apex_ompl.loop.tracking import Tracker, as_they_are
from apex_ompl.problems.worlds import World
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.trajectory import Trajectory


class Eyes(Protocol):
    """What observes a world."""

    def observations(self, until: float) -> Iterable[Observation]:
        """Return the observations with stamps up to a time [s] that were not returned before, in their order."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """What came of a run.

    Attributes:
        trajectory: What the robot did.
        events: What happened.
        reached: Whether the robot came to rest at a goal.
        ended: Why the run ended else: ``timeout`` or ``stuck``.
        broken: Number of steps at which an obstacle was where the assumptions of the guarantee exclude it.
    """

    trajectory: Trajectory
    events: tuple[Event, ...]
    reached: bool
    ended: str
    broken: int


def simulate(world: World, ready: Ready, replanner: Replanner, eyes: Eyes, seed: int) -> Simulated:
    """Run the loop in a world until the robot stands at a goal, or time is up.

    Args:
        world: What truly happens.
        ready: The robot among what stands still.
        replanner: How motions are planned anew.
        eyes: What observes the world.
        seed: Of random choices.
    """
    settings, allowed = ready.settings, tuple(ready.setup.problem.allowed)
    tracker = Tracker(ready.kernel, allowed=allowed)
    standing = Following.standing(ready.setup.start, 0.0, ready.names)
    executor = Executor(ready, replanner, tracker, seed, standing, followed=[(0.0, standing)])
    waiting: list[Observation] = []
    begun, rest, broken = False, 0.0, 0
    for k in range(math.ceil(settings.timeout / settings.period) + 1):
        now = k * settings.period
        world.advance(now, executor.state(now))
        waiting += eyes.observations(now)
        for observation in [one for one in waiting if one.received <= now + 1e-9]:
            tracker.take(observation)
        waiting = [one for one in waiting if one.received > now + 1e-9]
        present = world.present(now)
        broken += unexpected(tracker, present, now, settings.error, settings.fastest)
        if settings.prediction == "truth":
            predicted = as_they_are(ready.kernel, present, now, allowed)
            records = present
        else:
            predicted = tracker.predicted(settings.margin, settings.prediction)
            soon = now + np.array([0.0, 1.0, 2.0]) * settings.budget
            tracker.eased(predicted, executor.state(now), soon)
            records = _records(tracker, predicted, now)
        executor.step(now, predicted, records)
        if not begun and executor.route is not None:
            world.begin(executor.route.motion, executor.route.begin)
            begun = True
        if executor.done(now):
            executor.log(now, "goal")
            return _ended(executor, now, True, "", broken)
        rest = rest + settings.period if executor.following.at_rest(now) else 0.0
        if rest > settings.stuck:
            return _ended(executor, now, False, "stuck", broken)
    return _ended(executor, now, False, "timeout", broken)


def unexpected(tracker: Tracker, present: Iterable[Obstacle], now: float, error: float, fastest: float) -> bool:
    """Whether an obstacle is where the assumptions of the guarantee exclude it: unseen, or farther than it can be."""
    for o in present:
        track = tracker.tracks.get(o.name)
        if track is None:
            return True
        way = float(np.linalg.norm(np.subtract(o.position, track.shape.position)))
        if way > error + fastest * (now - track.stamp) + 1e-9:
            return True
    return False


def _records(tracker: Tracker, predicted: Movers, now: float) -> tuple[Obstacle, ...]:
    """Return the tracked obstacles where they are expected to be now, with their velocities."""
    places = predicted.at(now)
    return tuple(
        track.shape.model_copy(
            update={"position": tuple(places[name].tolist()), "velocity": tuple(track.velocity.tolist())}
        )
        for name, track in tracker.tracks.items()
    )


def _ended(executor: Executor, now: float, reached: bool, why: str, broken: int) -> Simulated:
    trajectory = executed(executor.followed, now)
    return Simulated(trajectory, tuple(executor.events), reached, why, broken)
