"""A run: a world that moves on, eyes that observe it, and a robot that follows exactly what it is told."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import numpy as np

from apex_ompl.live.movers import Movers
from apex_ompl.loop.executor import Executor
from apex_ompl.loop.following import SAME_TIME, Following, executed
from apex_ompl.loop.observation import Observation
from apex_ompl.loop.ready import Ready
from apex_ompl.loop.replanning import Replanning
from apex_ompl.loop.result import Event
from apex_ompl.loop.sensor import CUT
from apex_ompl.loop.tracking import Tracker, TrackSettings, as_they_are
from apex_ompl.problems.worlds import World
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at, vector
from apex_ompl.trajectory import Trajectory

LONGEST_STOP = 5.0  # behind which a run ends that does not come to rest when the time is up [s]


class Eyes(Protocol):
    """What observes a world."""

    def observations(self, until: float) -> Iterable[Observation]:
        """Return the observations with stamps up to a time [s] that were not returned before, in their order."""


@dataclass(frozen=True, eq=False)
class RunRecord:
    """What came of a run.

    Attributes:
        trajectory: What the robot did.
        events: What happened.
        reached: Whether the robot came to rest at a goal.
        ended: Why the run ended else: ``timeout`` or ``stuck``.
        broken: Number of steps at which an obstacle was where the assumptions of the guarantee exclude it.
        measured: What was measured on a real clock, by name.
    """

    trajectory: Trajectory
    events: tuple[Event, ...]
    reached: bool
    ended: str
    broken: int
    measured: Mapping[str, float] = field(default_factory=dict)


class Loop:
    """One run under way, step by step, on whatever clock.

    Attributes:
        executor: Decides what the robot follows.
    """

    def __init__(
        self, world: World, ready: Ready, replanning: Replanning, eyes: Eyes, seed: int, *, lead: float = 0.0
    ) -> None:  # fmt: skip
        """Begin with a robot that stands at the start.

        Args:
            world: What truly happens.
            ready: The robot among what stands still.
            replanning: Who plans motions anew.
            eyes: What observes the world.
            seed: Of random choices.
            lead: How long before a step it is decided [s].
        """
        self._world, self._ready, self._eyes = world, ready, eyes
        self._allowed = tuple(ready.setup.problem.allowed)
        tracking = TrackSettings(noise=ready.settings.error / CUT)
        self._tracker = Tracker(ready.kernel, tracking, self._allowed)
        start = ready.setup.start
        standing = Following.standing(start, 0.0, ready.names, to_goal=ready.is_goal(start))
        self.executor = Executor(
            ready, replanning, self._tracker, seed, standing, followed=[(0.0, standing)], lead=lead
        )  # fmt: skip
        self._waiting: list[Observation] = []
        self._begun, self._rest, self._broken = False, 0.0, 0
        self._present: tuple[Obstacle, ...] = ()
        self._looked = 0.0

    def advance(self, now: float) -> None:
        """Let the world move on to a time [s], and be looked at."""
        self._world.advance(now, self.executor.state(now))
        self._waiting += self._eyes.observations(now)
        self._present, self._looked = tuple(self._world.present(now)), now

    def observe(self, now: float) -> None:
        """Take the observations that have arrived by a time [s], to which the world has moved on."""
        settings = self._ready.settings
        for observation in [one for one in self._waiting if one.received <= now + 1e-9]:
            self._tracker.take(observation)
        self._waiting = [one for one in self._waiting if one.received > now + 1e-9]
        self._broken += unexpected(self._tracker, self._present, now, settings.error, settings.fastest)

    def step(self, now: float) -> RunRecord | None:
        """Decide what the robot does from a time on [s], and return what came of the run where it is over."""
        settings, tracker, executor = self._ready.settings, self._tracker, self.executor
        if settings.prediction == "truth":
            predicted = as_they_are(self._ready.kernel, self._present, self._looked, self._allowed)
        else:
            predicted = tracker.predicted(settings.margin, settings.prediction)
            soon = now + np.array([0.0, 1.0, 2.0]) * settings.budget
            tracker.eased(predicted, executor.state(now), soon)
        if now >= settings.timeout - SAME_TIME and not executor.done(now):
            executor.close(now)
        executor.step(now, predicted, partial(self._records, predicted, now))
        if executor.done(now):
            executor.log(now, "goal")
            return self._ended(now, True, "")
        self._rest = self._rest + settings.period if executor.following.at_rest(now) else 0.0
        if self._rest > settings.stuck:
            return self._ended(now, False, "stuck")
        over = executor.closed and (executor.following.at_rest(now) or now >= settings.timeout + LONGEST_STOP)
        return self._ended(now, False, "timeout") if over else None

    def set_out(self, now: float) -> None:
        """Tell the world of the first motion, where there is one by a time [s], that of the last step."""
        route = self.executor.route
        if not self._begun and route is not None:
            self._world.begin(route.motion, max(route.begin, now))
            self._begun = True

    def _records(self, predicted: Movers, now: float) -> tuple[Obstacle, ...]:
        """Return the obstacles where they are expected to be now, with the velocities that are expected."""
        prediction, tracks = self._ready.settings.prediction, self._tracker.tracks
        if prediction == "truth":
            return tuple(obstacle_at(o, now - self._looked) for o in self._present)
        places = predicted.at(now)
        velocities = {name: np.zeros(3) if prediction == "still" else track.velocity for name, track in tracks.items()}
        return tuple(
            track.shape.model_copy(update={"position": vector(places[name]), "velocity": vector(velocities[name])})
            for name, track in tracks.items()
        )

    def _ended(self, now: float, reached: bool, why: str) -> RunRecord:
        trajectory = executed(self.executor.followed, now)
        return RunRecord(trajectory, tuple(self.executor.events), reached, why, self._broken)


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
