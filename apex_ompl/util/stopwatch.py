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
