"""Clocks of a plan: its computation time by stage, and its deadline with a reserve for the proof."""

from __future__ import annotations

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager

RESERVE_SHARE, MIN_RESERVE, MAX_RESERVE = 0.1, 0.05, 0.5  # of the timeout, kept for proof and timing [1, s, s]
MAX_RESERVE_SHARE = 0.5  # for timeouts so short that MIN_RESERVE would be most of them


@contextmanager
def timed(times: MutableMapping[str, float], stage: str) -> Iterator[None]:
    """Add the seconds of a block to those of a stage, also if the block raises."""
    start = time.perf_counter()
    try:
        yield
    finally:
        times[stage] = times.get(stage, 0.0) + time.perf_counter() - start


class StageClock:
    """Time by stages that follow each other.

    Attributes:
        seconds: Time by stage [s].
    """

    def __init__(self, *stages: str) -> None:
        """Start the first of some stages."""
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last, self._inside = time.perf_counter(), 0.0

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage, less what :meth:`within` added to others."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last - self._inside
        self._last, self._inside = now, 0.0

    @contextmanager
    def within(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage, and exclude it from the stage of the next lap."""
        before = self.seconds[stage]
        with timed(self.seconds, stage):
            yield
        self._inside += self.seconds[stage] - before


class Deadline:
    """Moment at which a plan ends: a timeout after set-up, whose last part is a reserve for proof and timing.

    Attributes:
        timeout: The timeout [s].
        at: Value of ``time.perf_counter`` at the deadline [s].
    """

    def __init__(self, timeout: float) -> None:
        """Start a timeout [s] now."""
        self.timeout = timeout
        self.restart(timeout)

    @property
    def remaining(self) -> float:
        """Time left [s], 0 or more."""
        return max(0.0, self.at - time.perf_counter())

    @property
    def expired(self) -> bool:
        """Whether no time is left."""
        return self.remaining <= 0.0

    @property
    def reserve(self) -> float:
        """Time that the search leaves for proof and timing of its path [s].

        It is a tenth of the timeout, from 0.05 to 0.5 s, and never more than half of it.
        """
        least = min(MIN_RESERVE, MAX_RESERVE_SHARE * self.timeout)
        return max(least, min(RESERVE_SHARE * self.timeout, MAX_RESERVE))

    @property
    def for_search(self) -> float:
        """Time left without the reserve [s], 0 or more."""
        return max(0.0, self.at - self.reserve - time.perf_counter())

    def restart(self, remaining: float) -> None:
        """Move the deadline so that a time is left [s]."""
        self.at = time.perf_counter() + remaining

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time of a block."""
        left = self.at - time.perf_counter()
        try:
            yield
        finally:
            self.restart(left)
