"""Steps that were decided too late on the clock on the wall: they are undone, and a driver goes on with what it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from apex_ompl.loop.executor import Executor
from apex_ompl.moving.following import Following

DECISIONS = (
    "route", "leaving", "aside", "sets_out", "nearest", "ending", "conflict", "contact", "endangered", "ahead", "doing",
    "braking",
)  # fmt: skip
"""Attributes of an executor that go with what it follows."""
TAKEN = {"accepted": "rejected", "improved": "kept"}
"""Kinds of events of answers that were taken, and of those that came to nothing."""
UNSAID = ("stop", "reaction", "conflict")
"""Kinds of events that are undone with a step."""


@dataclass(frozen=True, eq=False)
class Decided:
    """What an executor had decided before a step, so that the step can be undone.

    Attributes:
        following: What the robot followed.
        stop: The stop in hand.
        events: Number of events.
        others: The attributes ``DECISIONS`` by name.
    """

    following: Following
    stop: Following | None
    events: int
    others: Mapping[str, Any]

    @classmethod
    def of(cls, executor: Executor) -> Decided:
        """Return what an executor has decided so far."""
        others = {name: getattr(executor, name) for name in DECISIONS}
        return cls(executor.following, executor.stop, len(executor.events), others)


def undo(executor: Executor, time: float, before: Decided) -> None:
    """Follow from a time on what a driver has, and undo what was decided since: that was not in time.

    Args:
        executor: The executor.
        time: Time of the clock [s].
        before: What had been decided; its stop, if there is one, begins at that time.
    """
    undone = executor.events[before.events :]
    del executor.events[before.events :]
    for event in undone:
        if event.kind in TAKEN:
            said = {name: event.data[name] for name in ("number", "part", "took")}
            executor.log(event.time, TAKEN[event.kind], why="the step that took it came too late", **said)
        elif event.kind not in UNSAID:
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
