"""SIGINT while planning: it ends plans where Python handles it, and is left to others where it is theirs."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from ompl import base as ob

from apex_ompl.ompl.process import Interrupt

LIBC = ctypes.CDLL(None)
LIBC.signal.restype = ctypes.c_void_p
C_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_int)


def press() -> None:
    """Send SIGINT to this process; Python's handler runs before the next line."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)


@pytest.fixture(autouse=True)
def handler_is_kept() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_it_ends_what_watches_and_is_raised_afterwards() -> None:
    condition = ob.plannerNonTerminatingCondition()
    with pytest.raises(KeyboardInterrupt), Interrupt() as interrupt, interrupt.ends(condition):
        assert not condition() and not interrupt.pressed
        press()
        assert condition() and interrupt.pressed
        later = ob.plannerNonTerminatingCondition()
        with interrupt.ends(later):
            assert later(), "what begins after it ends as well"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_users_handler_is_called_and_decides() -> None:
    called = list[int]()

    def noted(number: int, frame: object) -> None:
        called.append(number)

    signal.signal(signal.SIGINT, noted)
    with Interrupt() as interrupt:
        press()
        assert called == [signal.SIGINT] and not interrupt.pressed
    assert signal.getsignal(signal.SIGINT) is noted

    def raises(number: int, frame: object) -> None:
        raise ValueError("of the user")

    signal.signal(signal.SIGINT, raises)
    with pytest.raises(ValueError, match="of the user"), Interrupt() as interrupt:
        press()
        assert interrupt.pressed
    assert signal.getsignal(signal.SIGINT) is raises


def test_a_handler_that_is_set_meanwhile_stays() -> None:
    def later(number: int, frame: object) -> None: ...

    with Interrupt():
        signal.signal(signal.SIGINT, later)
    assert signal.getsignal(signal.SIGINT) is later


@pytest.mark.parametrize("handler", [signal.SIG_IGN, signal.SIG_DFL])
def test_what_is_ignored_or_left_to_the_system_stays_so(handler: signal.Handlers) -> None:
    signal.signal(signal.SIGINT, handler)
    with Interrupt() as interrupt:
        assert signal.getsignal(signal.SIGINT) is handler
        if handler is signal.SIG_IGN:
            press()
        assert not interrupt.pressed


def _before(set_handler: Callable[[], None]) -> Interrupt:
    set_handler()
    with Interrupt() as interrupt:
        press()
    return interrupt


def _meanwhile(set_handler: Callable[[], None]) -> Interrupt:
    with Interrupt() as interrupt:
        set_handler()
        press()
    return interrupt


@pytest.mark.parametrize("when", [_before, _meanwhile])
def test_a_handler_of_c_is_called_while_planning_and_afterwards(
    when: Callable[[Callable[[], None]], Interrupt],
) -> None:
    """As ROS 2 sets one: Python's own record says that its handler is still there."""
    called = list[int]()
    handler = C_HANDLER(called.append)
    interrupt = when(lambda: LIBC.signal(int(signal.SIGINT), handler))
    assert called == [signal.SIGINT] and not interrupt.pressed
    press()
    assert called == [signal.SIGINT] * 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_other_threads_have_no_handlers() -> None:
    found = []

    def plans() -> None:
        with Interrupt() as interrupt:
            found.append((interrupt.pressed, signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=plans)
    thread.start()
    thread.join()
    assert found == [(False, signal.default_int_handler)]
