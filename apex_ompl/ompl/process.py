"""OMPL's process-wide state: its log level, and the seed of its random numbers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ompl import util as ou

from apex_ompl.util.forking import ProcessLock

_lock = ProcessLock()
_levels: list[ou.LogLevel] = []


def seed_ompl(seed: int) -> None:
    """Seed the random number generators that OMPL makes from now on; 0 to 2^31 - 2."""
    with _lock:
        level = ou.getLogLevel()
        ou.setLogLevel(ou.LogLevel.LOG_NONE)  # it complains when generators were in use, and reseeds all the same
        ou.RNG.setSeed(int(seed) + 1)  # OMPL takes no seed 0
        ou.setLogLevel(level)


@contextmanager
def quiet_ompl() -> Iterator[None]:
    """Keep OMPL's information messages off standard output; warnings still go to standard error."""
    with _lock:
        if not _levels:
            _levels.append(ou.getLogLevel())
            ou.setLogLevel(ou.LogLevel.LOG_WARN)
        else:
            _levels.append(_levels[0])
    try:
        yield
    finally:
        with _lock:
            level = _levels.pop()
            if not _levels:  # the last of several in as many threads
                ou.setLogLevel(level)
