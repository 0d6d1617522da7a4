"""The control of a robot step by step: take observations, decide what it does, and undo decisions that came late."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from apex_ompl.loop.environment import Observation
from apex_ompl.loop.executor import Executor
from apex_ompl.loop.replanning import Replanning
from apex_ompl.loop.result import INTERRUPTED, Event
from apex_ompl.loop.sensor import CUT
from apex_ompl.loop.tracking import Tracker, TrackSettings
from apex_ompl.moving.context import SAME_TIME, Following, RunContext, executed
from apex_ompl.moving.dynamic_obstacles import DynamicObstacles
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.scripts import vector
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
    broken: int = 0
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


class Control:
    """Decides what a robot does from observations, on any clock.

    Attributes:
        context: The robot among static obstacles, and the settings of the run.
        tracker: Estimates of the obstacles.
        executor: Decides what the robot follows.
        aborted: Why the run is to end, or empty.
    """

    def __init__(
        self, context: RunContext, replanning: Replanning, seed: int, *, awaited: Iterable[str] = (), lead: float = 0.0
    ) -> None:
        """Set up a run with the robot at rest at the start.

        Args:
            context: The robot among static obstacles, and the settings of the run.
            replanning: Answers requests for replans.
            seed: Seed of random choices.
            awaited: Names of obstacles that must be seen before the robot moves.
            lead: How long before a step it is decided [s].
        """
        self.context, self.aborted = context, ""
        error, fastest = context.settings.assumed
        self.tracker = Tracker(
            context.kernel, TrackSettings(noise=error / CUT), tuple(context.setup.problem.allowed), error, fastest,
            context.settings.memory, set(awaited),
        )  # fmt: skip
        start = context.setup.start
        standing = Following.resting(start, 0.0, context.names, to_goal=context.is_goal(start))
        self.executor = Executor(
            context, replanning, self.tracker, seed, standing, followed=[(0.0, standing)], lead=lead
        )  # fmt: skip
        self._rest, self._refused, self._doubted, self._closed, self._refusal = 0.0, 0, 0, 0.0, ""

    def abort(self, why: str = "the interpreter ended") -> None:
        """Stop the robot and end the run for a reason; may be called from any thread."""
        self.aborted = self.aborted or why

    def interrupt(self, now: float, before: Decided) -> None:
        """Undo a step that was interrupted, and abort the run.

        Args:
            now: Time of the step [s].
            before: Decisions before the step.

        Raises:
            KeyboardInterrupt: The run was aborted before.
        """
        if self.aborted:
            raise KeyboardInterrupt
        undo(self.executor, now, before)
        self.abort(INTERRUPTED)

    def take(self, observation: Observation, now: float) -> None:
        """Take an observation at a time [s]."""
        taken = self.tracker.take(observation, now)
        self._refused += bool(taken.refused)
        self._doubted += len(taken.doubted)
        if taken.refused and taken.refused != self._refusal:
            self.executor.log(now, "observation refused", why=taken.refused)
        for why in taken.doubted:
            self.executor.log(now, "place doubted", why=why)
        self._refusal = taken.refused or self._refusal

    def predicted(self, now: float) -> DynamicObstacles:
        """Return the predicted obstacles at a time [s], with margins that let the robot rest where it is."""
        settings = self.context.settings
        soon = now + np.array([0.0, 1.0, 2.0]) * settings.budget
        found = self.tracker.predicted(settings.margin, settings.prediction)
        return self.tracker.ease_margins(found, self.executor.state(now), soon)

    def step(self, now: float) -> RunRecord | None:
        """Decide what the robot does from a time on [s], and return the record of the run where it is over."""
        return self.decide(now, self.predicted(now))

    def decide(
        self, now: float, predicted: DynamicObstacles, present: Callable[[], tuple[Obstacle, ...]] | None = None
    ) -> RunRecord | None:
        """Decide what the robot does from a time on [s], and return the record of the run where it is over.

        Args:
            now: The time.
            predicted: The predicted obstacles.
            present: Returns their records at that time, with velocities, where they are known better than by the
                estimates.
        """
        settings, executor = self.context.settings, self.executor
        if (self.aborted or now >= settings.timeout - SAME_TIME) and not executor.done(now):
            executor.close(now)
        executor.step(now, predicted, present or partial(self._records, predicted, now))
        if executor.done(now):
            executor.log(now, "goal")
            return self.ended(now, True, "")
        self._rest = self._rest + settings.period if executor.following.at_rest(now) else 0.0
        if self._rest > settings.stuck:
            return self.ended(now, False, "stuck")
        self._closed = self._closed if executor.closed else now
        over = executor.closed and (executor.following.at_rest(now) or now >= self._closed + LONGEST_STOP)
        return self.ended(now, False, "aborted" if self.aborted else "timeout") if over else None

    def _records(self, predicted: DynamicObstacles, now: float) -> tuple[Obstacle, ...]:
        """Return the obstacles at their predicted places now, with their predicted velocities."""
        still, tracks = self.context.settings.prediction == "still", self.tracker.tracks
        places = predicted.at(now)
        velocities = {name: np.zeros(3) if still else track.velocity for name, track in tracks.items()}
        return tuple(
            track.shape.model_copy(update={"position": vector(places[name]), "velocity": vector(velocities[name])})
            for name, track in tracks.items()
        )

    def ended(self, now: float, reached: bool, why: str) -> RunRecord:
        """Return the record of a run that ends at a time [s].

        Args:
            now: The time.
            reached: Whether the robot came to rest at a goal.
            why: Why it ended otherwise.
        """
        trajectory, reason = executed(self.executor.followed, now), self.aborted
        if not reached and not reason:
            awaited = f"never seen: {', '.join(sorted(self.tracker.awaited))}" if self.tracker.awaited else ""
            blind = "no observation was usable in the end" if self.executor.blind(now) else ""
            refused = f"{self._refused} observations were refused, the last one since {self._refusal}"
            reason = "; ".join(filter(None, (awaited, blind, refused if self._refused else "")))
        return RunRecord(
            trajectory, tuple(self.executor.events), reached, why, reason=reason,
            unguarded=self.executor.unguarded, refused=self._refused, doubted=self._doubted,
        )  # fmt: skip


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
