"""Who answers the executor's requests: a replanner at once, on the simulated clock, or a planner process."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol, Self

from apex_ompl.errors import PlannerProcessError
from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.replanner import Answer, Replanner, Request
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.robot.model import Limits
from apex_ompl.scene.problem import Problem
from apex_ompl.util.process import this_python

SHARE = 0.85  # of the budget after which nothing new is started
NOTICED = 0.003  # time after which a superseded replan ends [s]
STARTED = 120.0  # time that the planner process may take to become ready [s]
SENT = 2  # largest number of unanswered requests
HUNG = 10.0  # time without an answer after which the process is restarted [s]
WRITTEN = 1e-3  # time to wait for the last request to be written [s]
ENDED = 2.0  # time that the process may take to end [s]


@dataclass(frozen=True, eq=False)
class Reply:
    """The reply to a request.

    Attributes:
        number: Number of the request.
        answer: The replanner's answer.
        failed: Why nothing was found.
    """

    number: int
    answer: Answer
    failed: str = "nothing was found"


def reply_of(replanner: Replanner, context: RunContext, request: Request, budget: ComputeBudget) -> Reply:
    """Return the reply of a replanner; an exception becomes the reason why nothing was found."""
    try:
        answer: Any = replanner.replan(context, request, budget)
        if not isinstance(answer, Answer) or not isinstance(answer.found, Following | None):
            raise TypeError(f"{type(getattr(answer, 'found', answer)).__name__} is no answer")
    except Exception as error:  # whatever a replanner raises, the robot continues or stops
        return Reply(request.number, Answer(None, "", budget), f"{type(error).__name__}: {error}")
    return Reply(request.number, answer)


class Replanning(Protocol):
    """Answers requests for replans."""

    def submit(self, request: Request) -> bool:
        """Start a replan, and return whether it was started; it supersedes earlier requests."""

    def reply(self, now: float) -> Reply | None:
        """Return the reply that is available at a clock time [s], once."""

    def faults(self) -> tuple[str, ...]:
        """Return the faults since the last call, each in a few words."""


@dataclass(eq=False)
class ImmediateReplanning:
    """Replans at once; a reply is available when the work would be done by the compute-cost model.

    Attributes:
        context: The robot among static obstacles, and the settings of the run.
        replanner: The replanner.
    """

    context: RunContext
    replanner: Replanner
    _known: float = 0.0
    _reply: Reply | None = None

    def submit(self, request: Request) -> bool:
        """Replan."""
        settings = self.context.settings
        busy = self._reply is not None and request.asked < self._known - 1e-9
        budget = ComputeBudget(SHARE * settings.budget, NOTICED if busy else 0.0)
        self._reply = reply_of(self.replanner, self.context, request, budget)
        self._known = request.asked + (budget.spent if settings.latency < 0.0 else settings.latency)
        return True

    def reply(self, now: float) -> Reply | None:
        """Return the reply when it is available."""
        if self._reply is None or now < self._known - 1e-9:
            return None
        reply, self._reply = self._reply, None
        return reply

    def faults(self) -> tuple[str, ...]:
        """There are none."""
        return ()


@dataclass(frozen=True, eq=False)
class Work:
    """What a planner process needs; it is pickled to it.

    Attributes:
        problem: The problem without the dynamic obstacles.
        limits: Limits of motions.
        stopping: Limits of stops.
        settings: Parameters of the loop.
        make: Makes the replanner; a function or class of a module.
        arguments: Arguments of ``make``.
        seed: Seed of random choices.
        rehearses: Whether it makes replans of all kinds before it is ready, so that no code is loaded later.
    """

    problem: Problem
    limits: Limits
    stopping: Limits
    settings: LoopSettings
    make: Callable[..., Replanner]
    arguments: tuple[Any, ...]
    seed: int
    rehearses: bool = False


class PlannerProcess:
    """Replans in a process of its own, which is restarted when it dies.

    As a context manager it waits until the process is ready, and ends it.

    Attributes:
        process: The process.
        restarts: Number of restarts.
    """

    def __init__(self, work: Work, core: int | None = None) -> None:
        """Start a process.

        Args:
            work: What it needs.
            core: Processor core that it is pinned to; any by default.
        """
        self._work, self._core, self.restarts = work, core, 0
        self._faults: list[str] = []
        self._start()

    def _start(self) -> None:
        mine, other = multiprocessing.Pipe()
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
        command = [*this_python(), "-m", "apex_ompl.loop.planner_worker", str(other.fileno())]
        self.process = subprocess.Popen(
            command, pass_fds=[other.fileno()], env=environment, stdin=subprocess.DEVNULL, start_new_session=True
        )
        other.close()
        if self._core is not None:  # before its imports: it starts on the core that this thread is pinned to
            with suppress(OSError):
                os.sched_setaffinity(self.process.pid, {self._core})
        self._connection: Connection[Any, Any] = mine
        self._ready = False
        self._asked: list[float] = []
        self._send((sys.path, self._core, pickle.dumps(self._work)))

    def __enter__(self) -> Self:
        """Wait until it is ready.

        Raises:
            PlannerProcessError: It did not become ready.
        """
        try:
            if not self._connection.poll(STARTED):
                raise PlannerProcessError(f"the planner process was not ready within {STARTED:g} s")
            self._take(self._connection.recv())
        except (EOFError, OSError) as error:
            self.close()
            raise PlannerProcessError("the planner process died before it was ready") from error
        except BaseException:  # Ctrl-C among them
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    def _take(self, fault: str) -> None:
        if fault:
            raise PlannerProcessError(f"the planner process could not be made ready: {fault}")
        self._ready = True

    def submit(self, request: Request) -> bool:
        """Send a request, which ends the process's current replan; return whether it was sent.

        It is not sent where the process is not ready, or ``SENT`` requests are unanswered.
        """
        if not self._ready or len(self._asked) >= SENT:
            return False
        self._sender.join(WRITTEN)
        if self._sender.is_alive():
            return False
        self._send(request)
        self._asked.append(time.monotonic())
        return True

    def _send(self, message: object) -> None:
        """Send a message as it is now from a thread: a process that does not read blocks the writer."""
        self._sender = threading.Thread(target=_sent, args=(self._connection, pickle.dumps(message)), daemon=True)
        self._sender.start()

    def reply(self, now: float) -> Reply | None:
        """Return the newest reply that has arrived, if any; restart a process that has been busy for ``HUNG``."""
        del now
        newest = None
        if self._asked and time.monotonic() > self._asked[0] + HUNG:
            self._replace("did not answer")
        try:
            while self._connection.poll():
                message = self._connection.recv()
                if isinstance(message, str):
                    self._take(message)
                else:
                    newest = message
                    del self._asked[:1]
            if self.process.poll() is not None:  # a child of its own may still hold the connection open
                self._replace("died")
        except (EOFError, OSError):
            self._replace("died")
        except PlannerProcessError as error:
            self._faults.append(str(error))
        return newest

    def faults(self) -> tuple[str, ...]:
        """Return the faults since the last call."""
        found, self._faults = tuple(self._faults), []
        return found

    def _replace(self, why: str) -> None:
        """Restart the process."""
        self._faults.append(f"the planner process {why}")
        self.close(wait=0.0)
        self.restarts += 1
        self._start()

    def close(self, wait: float = ENDED) -> None:
        """End the process, by force where it does not end within some time [s]."""
        self._ready = False
        self._sender.join(wait)
        if self._sender.is_alive():
            self.process.kill()
            self._sender.join()
        self._connection.close()  # not earlier: what is still being sent would go to the next owner of the descriptor
        try:
            self.process.wait(wait)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _sent(connection: Connection[Any, Any], message: bytes) -> None:
    """Send a message to a process that may not read it; where it has died, the next call of ``reply`` finds out."""
    with suppress(OSError):
        connection.send_bytes(message)
