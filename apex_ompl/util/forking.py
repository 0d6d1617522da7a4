"""``os.fork`` while other threads are at work: a child has only the thread that forked, and all locks as they were.

What another thread held then would never be opened. So a fork waits until no thread is preparing its first plan, which
imports modules (whose locks are Python's own), and the locks of this package are open in the child.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from weakref import WeakSet

_locks: WeakSet[ProcessLock] = WeakSet()


class ProcessLock:
    """Reentrant lock that is open in a forked child, whichever thread of the parent held it."""

    def __init__(self) -> None:
        """Make an open lock."""
        self._lock = threading.RLock()
        _locks.add(self)

    def __enter__(self) -> None:
        """Wait for the lock and close it."""
        self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Open the lock."""
        self._lock.release()

    def renew(self) -> None:
        """Open the lock in a child."""
        self._lock = threading.RLock()


class _Preparations:
    """Threads that must not be forked away from what they do."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._threads: list[int] = []

    def begin(self) -> None:
        with self._changed:
            self._threads.append(threading.get_ident())

    def end(self) -> None:
        with self._changed:
            self._threads.remove(threading.get_ident())
            self._changed.notify_all()

    def before_fork(self) -> None:
        self._changed.acquire()
        mine = threading.get_ident()
        self._changed.wait_for(lambda: all(thread == mine for thread in self._threads))

    def after_fork(self) -> None:
        self._changed.release()


_preparations = _Preparations()


@contextmanager
def unforked() -> Iterator[None]:
    """While the block runs, let other threads wait with ``os.fork``; for what imports modules or compiles code."""
    _preparations.begin()
    try:
        yield
    finally:
        _preparations.end()


def _in_child() -> None:
    _preparations.after_fork()
    for lock in list(_locks):
        lock.renew()


os.register_at_fork(
    before=_preparations.before_fork, after_in_parent=_preparations.after_fork, after_in_child=_in_child
)
