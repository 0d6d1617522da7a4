"""OMPL in this process: its log level, the seed of its random numbers, Ctrl-C, and deadlines."""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

from ompl import base as ob
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


MAX_TIME = 1e8  # OMPL counts nanoseconds in 64 bits [s]
ROOM = 512  # for a C struct sigaction, which has 152 bytes on x86-64 [bytes]


def ends_after(seconds: float) -> ob.PlannerTerminationCondition:
    """Return OMPL's condition that holds after a time [s], which may be negative, or longer than OMPL can count.

    It is made in C++: planners that run threads deadlock with one made in Python.
    """
    return ob.timedPlannerTerminationCondition(min(max(seconds, 0.0), MAX_TIME))


class Interrupt:
    """Calls Python's handler of SIGINT while planning; an exception of it ends the planner, and is raised afterwards.

    Nothing may be raised inside OMPL's callbacks.

    Outside the main thread, where Python allows no signal handlers, it does nothing, nor where SIGINT is ignored, or
    handled by C code (as of ROS 2): that stays as it is.

    Attributes:
        pressed: Whether planning is to end.
    """

    def __init__(self) -> None:
        """Start without a handler; the ``with`` statement sets it."""
        self.pressed = False
        self._conditions: list[ob.PlannerTerminationCondition] = []
        self._before: Callable[[int, FrameType | None], Any] | None = None
        self._mine = _Disposition()
        self._raised: BaseException | None = None

    def __enter__(self) -> Self:
        """Take SIGINT over."""
        if threading.current_thread() is threading.main_thread():
            before, found = signal.getsignal(signal.SIGINT), _Disposition()
            if callable(before):
                signal.signal(signal.SIGINT, self._handle)
                self._before, self._mine = before, _Disposition()
                if self._mine != found:  # C code has taken it after Python
                    self._give_back()
                    found.restore()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore SIGINT's handler, and raise the exception of the handler."""
        if self._before is not None and signal.getsignal(signal.SIGINT) == self._handle:
            found = _Disposition()
            self._give_back()
            if found != self._mine:  # C code has taken it in the meantime
                found.restore()
        if self._raised is not None:
            raise self._raised

    @contextmanager
    def ends(self, condition: ob.PlannerTerminationCondition) -> Iterator[ob.PlannerTerminationCondition]:
        """While the block runs, let SIGINT end the planner that watches ``condition``."""
        self._conditions.append(condition)
        if self.pressed:
            condition.terminate()
        try:
            yield condition
        finally:
            self._conditions.remove(condition)

    def end(self) -> None:
        """End the planner at work, and those to come."""
        self.pressed = True
        for condition in list(self._conditions):
            condition.terminate()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        assert self._before is not None
        try:
            self._before(number, frame)
        except BaseException as error:
            self._raised = error
            self.end()

    def _give_back(self) -> None:
        signal.signal(signal.SIGINT, self._before)
        self._before = None


class _Disposition:
    """Disposition of SIGINT in the operating system: Python does not know handlers that C code sets."""

    def __init__(self) -> None:
        self._action = ctypes.create_string_buffer(ROOM)
        ctypes.CDLL(None).sigaction(int(signal.SIGINT), None, self._action)

    def __eq__(self, other: object) -> bool:
        """Whether the handler is the same."""
        return isinstance(other, _Disposition) and self._handler == other._handler

    __hash__ = None  # type: ignore[assignment]

    @property
    def _handler(self) -> bytes:
        return self._action.raw[: ctypes.sizeof(ctypes.c_void_p)]  # first member of the struct

    def restore(self) -> None:
        ctypes.CDLL(None).sigaction(int(signal.SIGINT), self._action, None)
