"""This process: its cores and its interpreter, the thread count of torch, and the end of its daemon threads.

A thread that runs C++ code when Python ends it takes the whole process down (``PyGILState_Release``, SIGABRT), and
OMPL's planners call Python all the time. So work in such threads is asked to end (:func:`running`), and its thread
stands still afterwards.

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
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise

from apex_ompl.util.forking import ProcessLock

PATIENCE = 20.0  # how long the interpreter waits for running work; the set-up of a planner ends by itself [s]
LOOK = 0.01  # between two looks [s]
PART = 256  # rows of arrays, fewer than which are not worth a thread of their own

_code: int | None = None  # of the process, where it is to end quickly


def end_quickly(code: int) -> int:
    """Let the process end without freeing its memory, once threads and exit functions are done; return its code.

    Args:
        code: Exit code of the process; the caller must end the process with the same code.
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
    except (OSError, ValueError):  # the interpreter reports it as it ends
        return
    os._exit(_code)


def _stay() -> None:
    global _code  # noqa: PLW0603
    _code = None


class _Work:
    """Work that runs now, in any thread."""

    def __init__(self) -> None:
        self._lock = ProcessLock()
        self._ends: dict[object, Callable[[], object]] = {}  # how to ask each to end
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
            with self._lock:  # no work ends meanwhile, so that no condition that is gone is notified
                for tell in self._ends.values():
                    tell()
            time.sleep(LOOK)

    def forget(self) -> None:
        self._ends.clear()
        self._here.depth = 0


_work = _Work()


@contextmanager
def running(end: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Let the interpreter ask the block to end, and wait for it, before the interpreter ends.

    A daemon thread that enters or leaves such a block after that stands still; it ends with the process.

    Args:
        end: Asks the block to end; called from another thread, and more than once.
    """
    with _work.running(end):
        yield


atexit.register(_leave)  # the first, so that it is called last
atexit.register(_work.end)
os.register_at_fork(after_in_child=_work.forget)
os.register_at_fork(after_in_child=_stay)


def usable_cores() -> tuple[int, ...]:
    """Return the numbers of the cores that this process may use, in increasing order."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def this_python() -> list[str]:
    """Return the command of this interpreter with its level of optimization, for which compiled code is kept apart."""
    return [sys.executable, *(["-" + "O" * sys.flags.optimize] if sys.flags.optimize else [])]


_lock = ProcessLock()
_before: list[int] = []  # thread count to restore, one entry for each active block


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute by one thread inside the block, and restore the thread count afterwards.

    Small networks are evaluated by one thread, as several wait for each other on busy cores. Blocks may overlap in
    several threads; the last one to end restores the count.
    """
    import torch

    with _lock:
        _before.append(_before[0] if _before else torch.get_num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            count = _before.pop()
            if not _before:
                torch.set_num_threads(count)


def in_threads(count: int, threads: int, call: Callable[[slice], None]) -> None:
    """Call with slices that together are all of some rows, several at once in threads.

    Compiled code needs no lock of the interpreter.

    Raises:
        ParameterError: The number of threads is no positive whole number.
    """
    from apex_ompl.util.validation import check_integer  # which imports NumPy

    parts = min(check_integer(threads, "threads", 1), max(count // PART, 1))
    if parts == 1:
        call(slice(count))
        return
    edges = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(call, (slice(first, end) for first, end in pairwise(edges))))
