"""What ends work inside of OMPL early: Ctrl-C, which must not raise in its callbacks, and the end of time."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from ompl import base as ob

from apex_ompl.ompl_adapter.validity import MotionValidator

MAX_TIME = 1e8  # OMPL counts nanoseconds in 64 bits [s]


def ends_after(seconds: float) -> ob.PlannerTerminationCondition:
    """Return OMPL's condition that holds after a time [s], which may be negative, or longer than OMPL can count.

    It is made in C++: planners that run threads deadlock with one made in Python.
    """
    return ob.timedPlannerTerminationCondition(min(max(seconds, 0.0), MAX_TIME))


class Interrupt:
    """Holds SIGINT back while planning: it ends the planner at work, and is raised when planning has ended.

    Outside the main thread, where Python allows no signal handlers, it does nothing.

    Attributes:
        pressed: Whether SIGINT came.
    """

    def __init__(self) -> None:
        """Start without a handler; the ``with`` statement sets it."""
        self.pressed = False
        self._conditions: list[ob.PlannerTerminationCondition] = []
        self._before: Any = None

    def __enter__(self) -> Self:
        """Take SIGINT over."""
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give SIGINT back, and raise KeyboardInterrupt when it came.

        Raises:
            KeyboardInterrupt: SIGINT came in the meantime.
        """
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)
        if self.pressed:
            raise KeyboardInterrupt

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

    def _handle(self, *_: object) -> None:
        self.pressed = True
        for condition in self._conditions:
            condition.terminate()


@contextmanager
def motions_until(validator: MotionValidator, stop: Callable[[], bool]) -> Iterator[None]:
    """While the block runs, let all motions be invalid once ``stop`` holds.

    OMPL looks at a termination condition between iterations and not inside of them, and simplifies paths by counts:
    without motions to check, both soon come to their end.
    """
    check = validator.check
    validator.check = lambda first, second: not stop() and check(first, second)
    try:
        yield
    finally:
        validator.check = check
