"""Computation time by stage."""

from __future__ import annotations

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager


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
        """Begin the first of some stages."""
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last, self._inside = time.perf_counter(), 0.0

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage, less what :meth:`within` added to others."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last - self._inside
        self._last, self._inside = now, 0.0

    @contextmanager
    def within(self, stage: str) -> Iterator[None]:
        """Add the time of a block to a stage, and not to the one that the next lap ends."""
        before = self.seconds[stage]
        with timed(self.seconds, stage):
            yield
        self._inside += self.seconds[stage] - before
