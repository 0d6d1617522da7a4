"""A run step by step: advance the environment, take observations, decide what the robot does, and undo late steps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from apex_ompl.loop.environment import Environment, Observation, ObservationSource
from apex_ompl.loop.executor import Executor
from apex_ompl.loop.replanning import Replanning
from apex_ompl.loop.result import INTERRUPTED, Event
from apex_ompl.loop.sensor import CUT
from apex_ompl.loop.tracking import Tracker, TrackSettings, true_motions
from apex_ompl.moving.context import SAME_TIME, Following, RunContext, executed
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import obstacle_at, vector
from apex_ompl.timing import Trajectory

LONGEST_STOP = 5.0  # after which a run ends whose robot does not come to rest when the time is up [s]
DECISIONS = (
    "route", "leaving", "aside", "departure", "nearest", "ending", "conflict", "contact", "conflict_since", "ahead",
    "doing", "braking",
)  # fmt: skip
"""Attributes of an executor that are decided together with what it follows."""
TAKEN = {"accepted": "rejected", "improved": "kept"}
"""Kinds of events of answers that were taken, and of answers that were not."""
UNDONE = ("stop", "reaction", "conflict")
"""Kinds of events that are removed with a step."""


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The record of a run, before the referee judges it.

    Attributes:
        trajectory: The executed motion.
        events: What happened.
        reached: Whether the robot came to rest at a goal.
        ended: Why the run ended otherwise: ``timeout``, ``stuck`` or ``aborted``.
        broken: Number of steps at which an obstacle was where the assumptions of the guarantee exclude it.
        measured: Computing times on the wall clock, by name.
        reason: Why the run ended, where more is known.
        unguarded: Number of steps at which the robot moved without a fail-safe stop.
        refused: Number of observations that were refused.
        doubted: Number of observed places that contradicted earlier ones.
    """

    trajectory: Trajectory
    events: tuple[Event, ...]
    reached: bool
    ended: str
    broken: int
    measured: Mapping[str, float] = field(default_factory=dict)
    reason: str = ""
    unguarded: int = 0
    refused: int = 0
    doubted: int = 0

    @property
    def counts(self) -> dict[str, float]:
        """Counts by the names of metrics."""
        counts = {"broken_steps": self.broken, "unguarded_steps": self.unguarded}
        counts |= {"refused_looks": self.refused, "doubted_places": self.doubted}
        return {name: float(count) for name, count in counts.items()}


class Loop:
    """One run, step by step, on any clock.

    Attributes:
        executor: Decides what the robot follows.
    """

    def __init__(
        self, environment: Environment, context: RunContext, replanning: Replanning, sensor: ObservationSource,
        seed: int, *, lead: float = 0.0,
    ) -> None:  # fmt: skip
        """Set up a run with the robot at rest at the start.

        Args:
            environment: What truly happens.
            context: The robot among static obstacles, and the settings of the run.
            replanning: Answers requests for replans.
            sensor: Observes the environment.
            seed: Seed of random choices.
            lead: How long before a step it is decided [s].
        """
        self._environment, self._context, self._sensor = environment, context, sensor
        self._allowed = tuple(context.setup.problem.allowed)
        error, fastest = context.settings.assumed
        self._present: tuple[Obstacle, ...] = tuple(environment.present(0.0))
        self._tracker = Tracker(
            context.kernel, TrackSettings(noise=error / CUT), self._allowed, error, fastest, context.settings.memory,
            {o.name for o in self._present},
        )  # fmt: skip
        start = context.setup.start
        standing = Following.resting(start, 0.0, context.names, to_goal=context.is_goal(start))
        self.executor = Executor(
            context, replanning, self._tracker, seed, standing, followed=[(0.0, standing)], lead=lead
        )  # fmt: skip
        self._waiting: list[Observation] = []
        self._started, self._rest, self._broken, self._refused, self._doubted = False, 0.0, 0, 0, 0
        self._present_time, self._closed, self._aborted, self._refusal = 0.0, 0.0, "", ""

    def advance(self, now: float) -> None:
        """Advance the environment to a time [s], and collect the observations until then."""
        self._environment.advance(now, self.executor.state(now))
        if not self._aborted:
            try:
                self._waiting += self._sensor.observations(now)
            except Exception as error:  # whatever a sensor raises, the robot stops and the run is returned
                self.abort(f"the sensor failed, {type(error).__name__}: {error}")
        self._present, self._present_time = tuple(self._environment.present(now)), now

    def abort(self, why: str = "the interpreter ended") -> None:
        """Stop the robot and end the run for a reason; may be called from any thread."""
        self._aborted = self._aborted or why

    def interrupt(self, now: float, before: Decided) -> None:
        """Undo a step that was interrupted, and abort the run.

        Args:
            now: Time of the step [s].
            before: Decisions before the step.

        Raises:
            KeyboardInterrupt: The run was aborted before.
        """
        if self._aborted:
            raise KeyboardInterrupt
        undo(self.executor, now, before)
        self.abort(INTERRUPTED)

    def observe(self, now: float) -> None:
        """Take the observations that were received by a time [s], to which the environment was advanced."""
        later = []
        for observation in self._waiting:
            if observation.received > now + 1e-9:
                later.append(observation)
                continue
            taken = self._tracker.take(observation, now)
            self._refused += bool(taken.refused)
            self._doubted += len(taken.doubted)
            if taken.refused and taken.refused != self._refusal:
                self.executor.log(now, "observation refused", why=taken.refused)
            for why in taken.doubted:
                self.executor.log(now, "place doubted", why=why)
            self._refusal = taken.refused or self._refusal
        self._waiting = later
        self._broken += unexpected(self._tracker, self._present, now)

    def step(self, now: float) -> RunRecord | None:
        """Decide what the robot does from a time on [s], and return the record of the run where it is over."""
        settings, tracker, executor = self._context.settings, self._tracker, self.executor
        if settings.prediction == "truth":
            predicted = true_motions(self._context.kernel, self._present, self._present_time, self._allowed)
        else:
            predicted = tracker.predicted(settings.margin, settings.prediction)
            soon = now + np.array([0.0, 1.0, 2.0]) * settings.budget
            tracker.ease_margins(predicted, executor.state(now), soon)
        if (self._aborted or now >= settings.timeout - SAME_TIME) and not executor.done(now):
            executor.close(now)
        executor.step(now, predicted, partial(self._records, predicted, now))
        if executor.done(now):
            executor.log(now, "goal")
            return self._ended(now, True, "")
        self._rest = self._rest + settings.period if executor.following.at_rest(now) else 0.0
        if self._rest > settings.stuck:
            return self._ended(now, False, "stuck")
        self._closed = self._closed if executor.closed else now
        over = executor.closed and (executor.following.at_rest(now) or now >= self._closed + LONGEST_STOP)
        return self._ended(now, False, "aborted" if self._aborted else "timeout") if over else None

    def announce_start(self, now: float) -> None:
        """Tell the environment of the first motion to a goal, once; the time is that of the last step [s]."""
        route = self.executor.route
        if not self._started and route is not None:
            self._environment.start(route.motion, max(route.start_time, now))
            self._started = True

    def _records(self, predicted: DynamicObstacles, now: float) -> tuple[Obstacle, ...]:
        """Return the obstacles at their predicted places now, with their predicted velocities."""
        prediction, tracks = self._context.settings.prediction, self._tracker.tracks
        if prediction == "truth":
            return tuple(obstacle_at(o, now - self._present_time) for o in self._present)
        places = predicted.at(now)
        velocities = {name: np.zeros(3) if prediction == "still" else track.velocity for name, track in tracks.items()}
        return tuple(
            track.shape.model_copy(update={"position": vector(places[name]), "velocity": vector(velocities[name])})
            for name, track in tracks.items()
        )

    def _ended(self, now: float, reached: bool, why: str) -> RunRecord:
        trajectory, reason = executed(self.executor.followed, now), self._aborted
        if not reached and not reason:
            awaited = f"never seen: {', '.join(sorted(self._tracker.awaited))}" if self._tracker.awaited else ""
            blind = "no observation was usable in the end" if self.executor.blind(now) else ""
            refused = f"{self._refused} observations were refused, the last one since {self._refusal}"
            reason = "; ".join(filter(None, (awaited, blind, refused if self._refused else "")))
        return RunRecord(
            trajectory, tuple(self.executor.events), reached, why, self._broken, reason=reason,
            unguarded=self.executor.unguarded, refused=self._refused, doubted=self._doubted,
        )  # fmt: skip


def unexpected(tracker: Tracker, present: Iterable[Obstacle], now: float) -> bool:
    """Whether an obstacle violates the assumptions of the guarantee: unseen, or outside its reachable set."""
    for o in present:
        known = [track for track in (*tracker.tracks.values(), *tracker.doubted) if track.shape.name == o.name]
        if not any(tracker.may_be(track, o, now, errors=1) for track in known):
            return True
    return False


@dataclass(frozen=True, eq=False)
class Decided:
    """The decisions of an executor before a step, so that the step can be undone.

    Attributes:
        following: The motion that the robot followed.
        stop: The fail-safe stop.
        events: Number of events.
        others: The attributes ``DECISIONS`` by name.
    """

    following: Following
    stop: Following | None
    events: int
    others: Mapping[str, Any]

    @classmethod
    def of(cls, executor: Executor) -> Decided:
        """Return the decisions of an executor so far."""
        others = {name: getattr(executor, name) for name in DECISIONS}
        return cls(executor.following, executor.stop, len(executor.events), others)


def undo(executor: Executor, time: float, before: Decided) -> None:
    """Undo a step that was decided too late: follow what the driver holds from a time on.

    Args:
        executor: The executor.
        time: Clock time [s].
        before: Decisions before the step; their stop, if there is one, starts at that time.
    """
    undone = executor.events[before.events :]
    del executor.events[before.events :]
    for event in undone:
        if event.kind in TAKEN:
            kept = {name: event.data[name] for name in ("number", "part", "took")}
            executor.log(event.time, TAKEN[event.kind], why="the step that took it came too late", **kept)
        elif event.kind not in UNDONE:
            executor.events.append(event)
    executor.log(time, "late")
    for name, value in before.others.items():
        setattr(executor, name, value)
    executor.stop, executor.following = before.stop, before.following
    if executor.stop is not None and not executor.following.at_rest(time):
        executor.following = executor.stop
    if executor.following is not executor.followed[-1][1]:
        executor.follow(executor.following, time)
    if executor.pending is not None and executor.pending.following is not executor.following:
        executor.pending = None
