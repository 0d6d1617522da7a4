"""What replans of the closed loop take in runs, beside what they were charged."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from apex_ompl import run
from apex_ompl.loop import replanning
from apex_ompl.loop.replanning import Reply
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import RunContext
from apex_ompl.moving.replanner import Replanner, Request


@dataclass
class ReplanTimes:
    """What replans took.

    Attributes:
        seconds: In sum [s].
        counts: What they were charged, in units by kind of work.
        replans: Their number.
    """

    seconds: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)
    replans: int = 0

    def spending(self, costs: Mapping[str, float], kinds: Sequence[str] | None = None) -> float:
        """Return what they are charged by costs of a unit [s], for some kinds of work or for all [s]."""
        return sum(costs[kind] * self.counts[kind] for kind in (self.counts if kinds is None else kinds))

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Add what replans take that are answered inside a block."""
        reply_of = replanning.reply_of

        def watched(replanner: Replanner, context: RunContext, request: Request, budget: ComputeBudget) -> Reply:
            begin = time.perf_counter()
            reply = reply_of(replanner, context, request, budget)
            self.seconds += time.perf_counter() - begin
            self.counts += budget.counts
            self.replans += 1
            return reply

        replanning.reply_of = watched
        try:
            yield
        finally:
            replanning.reply_of = reply_of


def replan_times(method: str, names: Sequence[str]) -> ReplanTimes:
    """Return what replans take in runs on the simulated clock; an untimed run before them loads all code."""
    run(names[0], method=method)
    found = ReplanTimes()
    with found.watching():
        for name in names:
            run(name, method=method)
    return found
