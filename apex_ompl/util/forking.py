"""``os.fork`` while other threads run: a child has only the thread that forked, and all locks as they were.

A lock that another thread held then would never be released. So a fork waits until no thread prepares a plan, which
imports modules (whose locks are Python's own), or compiles code; and the locks of this package are open in the child.
"""

from __future__ import annotations

import concurrent.futures.thread  # noqa: F401 - see below
import logging  # noqa: F401
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from weakref import WeakSet

PATIENCE = 300.0  # how long a fork waits for other threads before it proceeds regardless [s]


class ProcessLock:
    """Reentrant lock that is open in a forked child, whichever thread of the parent held it."""

    _all: WeakSet[ProcessLock] = WeakSet()

    def __init__(self) -> None:
        """Make an open lock."""
        self._lock = threading.RLock()
        self._all.add(self)

    def __enter__(self) -> None:
        """Wait for the lock and close it."""
        self._lock.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Open the lock."""
        self._lock.release()

    @classmethod
    def open_all(cls) -> None:
        """Open all locks, in a child."""
        for lock in list(cls._all):
            lock._lock = threading.RLock()


class _Gate:
    """The conditions that a fork waits for."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._preparing: list[int] = []  # threads
        self._compiling: list[threading.RLock] = []  # locks of others
        self._held: list[threading.RLock] = []

    @contextmanager
    def unforked(self) -> Iterator[None]:
        with self._changed:
            self._preparing.append(threading.get_ident())
        try:
            yield
        finally:
            with self._changed:
                self._preparing.remove(threading.get_ident())
                self._changed.notify_all()

    def hold(self, lock: threading.RLock) -> None:
        self._compiling.append(lock)

    def before(self) -> None:
        self._changed.acquire()
        mine = threading.get_ident()
        self._changed.wait_for(lambda: all(thread == mine for thread in self._preparing), PATIENCE)
        self._held = [lock for lock in self._compiling if lock.acquire(timeout=PATIENCE)]

    def after_in_parent(self) -> None:
        while self._held:
            self._held.pop().release()
        self._changed.release()

    def after_in_child(self) -> None:
        mine = threading.get_ident()
        self._preparing = [thread for thread in self._preparing if thread == mine]
        self.after_in_parent()
        ProcessLock.open_all()


_gate = _Gate()
unforked = _gate.unforked
"""Context: let other threads delay ``os.fork`` meanwhile; for code that imports modules, as a plan's set-up."""
hold_at_fork = _gate.hold
"""Let every fork wait for a lock, and hold it meanwhile, so that it is open in the child, too."""

# The hook that is registered last is called first before a fork. The two modules above hold their own locks, which the
# work that a fork waits for may need, so that they must have registered before.
os.register_at_fork(before=_gate.before, after_in_parent=_gate.after_in_parent, after_in_child=_gate.after_in_child)
