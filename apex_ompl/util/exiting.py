"""The end of the interpreter: work of daemon threads is told to end and waited for.

A thread that is inside of C++ code when Python ends it takes the whole process down (``PyGILState_Release``, SIGABRT),
and OMPL's planners call Python all the time. So what runs there is told to end, and its thread stands still afterwards.

A command ends without freeing its memory piece by piece (:func:`end_quickly`), a tenth of the time of a short one.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from apex_ompl.util.forking import ProcessLock

PATIENCE = 20.0  # how long the interpreter waits for what runs; the set-up of a planner ends by itself [s]
LOOK = 0.01  # between two looks [s]


_code: int | None = None  # of the process, where it is to end quickly


def end_quickly(code: int) -> int:
    """Let the process end without freeing what it holds, once threads and exit functions are done; return its code.

    Args:
        code: Exit code of the process, which must be the one that it is ended with.
    """
    global _code  # noqa: PLW0603 - there is one process
    _code = code
    return code


def _leave() -> None:
    if _code is None:
        return
    logging.shutdown()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):  # the interpreter says so as it ends
        return
    os._exit(_code)


def _stay() -> None:
    global _code  # noqa: PLW0603
    _code = None


class _Work:
    """What runs now, in any thread."""

    def __init__(self) -> None:
        self._lock = ProcessLock()
        self._ends: dict[object, Callable[[], object]] = {}  # how to tell each to end
        self._here = threading.local()  # how many blocks the thread is in
        self._over = False

    @contextmanager
    def running(self, end: Callable[[], object]) -> Iterator[None]:
        depth, key = getattr(self._here, "depth", 0), object()
        if not depth:
            self._stand_still_at_the_end()
        self._here.depth = depth + 1
        with self._lock:
            self._ends[key] = end
        try:
            yield
        finally:
            self._here.depth = depth
            with self._lock:
                self._ends.pop(key, None)
            if not depth:
                self._stand_still_at_the_end()

    def _stand_still_at_the_end(self) -> None:
        if self._over and threading.current_thread().daemon:
            threading.Event().wait()

    def end(self) -> None:
        self._over = True
        patience = time.monotonic() + PATIENCE
        while self._ends and time.monotonic() < patience:
            with self._lock:  # none ends meanwhile, so that nothing is told to a condition that is gone
                for tell in self._ends.values():
                    tell()
            time.sleep(LOOK)

    def forget(self) -> None:
        self._ends.clear()
        self._here.depth = 0


_work = _Work()


@contextmanager
def running(end: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Let the interpreter tell the block to end, and wait for it, before it ends itself.

    A daemon thread that begins or leaves such a block after that stands still; it ends with the process.

    Args:
        end: Tells the block to end; called from another thread, and more than once.
    """
    with _work.running(end):
        yield


atexit.register(_leave)  # the first, so that it is called last
atexit.register(_work.end)
os.register_at_fork(after_in_child=_work.forget)
os.register_at_fork(after_in_child=_stay)
