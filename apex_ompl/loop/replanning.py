"""How the executor has its replans made: at once on a simulated clock, or elsewhere on a real one."""

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
from apex_ompl.util.interpreter import this_python

SHARE = 0.85  # of the budget after which nothing new is begun
NOTICED = 0.003  # time after which a replan that another one has overtaken ends [s]


@dataclass(frozen=True, eq=False)
class Reply:
    """What came of a request.

    Attributes:
        number: Of the request.
        answer: What was found.
        failed: Why nothing was found.
    """

    number: int
    answer: Answer
    failed: str = "nothing was found"


def reply_of(replanner: Replanner, context: RunContext, request: Request, budget: ComputeBudget) -> Reply:
    """Return what a way of replanning answers; whatever it raises is a reason."""
    try:
        answer: Any = replanner.replan(context, request, budget)
        if not isinstance(answer, Answer) or not isinstance(answer.found, Following | None):
            raise TypeError(f"{type(getattr(answer, 'found', answer)).__name__} is no answer")
    except Exception as error:  # whatever a way of replanning does, the robot goes on or stops
        return Reply(request.number, Answer(None, "", budget), f"{type(error).__name__}: {error}")
    return Reply(request.number, answer)


class Replanning(Protocol):
    """Who makes replans."""

    def submit(self, request: Request) -> bool:
        """Begin a replan, and return whether it was; what was asked for before is of no use any more."""

    def reply(self, now: float) -> Reply | None:
        """Return what is known by a time of the clock [s], once."""

    def faults(self) -> tuple[str, ...]:
        """Return what went wrong since the last call, each in a few words."""


@dataclass(eq=False)
class ImmediateReplanning:
    """Replans made when they are asked for, whose answers are known when the work would be done by the table of costs.

    Attributes:
        context: The robot among what stands still.
        replanner: The way of replanning.
    """

    context: RunContext
    replanner: Replanner
    _known: float = 0.0
    _reply: Reply | None = None

    def submit(self, request: Request) -> bool:
        """Make a replan."""
        settings = self.context.settings
        busy = self._reply is not None and request.asked < self._known - 1e-9
        budget = ComputeBudget(SHARE * settings.budget, NOTICED if busy else 0.0)
        self._reply = reply_of(self.replanner, self.context, request, budget)
        self._known = request.asked + (budget.spent if settings.latency < 0.0 else settings.latency)
        return True

    def reply(self, now: float) -> Reply | None:
        """Return the answer when it is known."""
        if self._reply is None or now < self._known - 1e-9:
            return None
        reply, self._reply = self._reply, None
        return reply

    def faults(self) -> tuple[str, ...]:
        """Nothing goes wrong."""
        return ()


STARTED = 120.0  # time that the process has to make itself ready [s]
SENT = 2  # requests at most that are not answered yet
HUNG = 10.0  # time without an answer after which the process is made anew [s]
WRITTEN = 1e-3  # time that is waited for the request before to be written [s]
ENDED = 2.0  # time that it has to end [s]


@dataclass(frozen=True, eq=False)
class Work:
    """What a planner process is to do; it travels to it.

    Attributes:
        problem: The problem without the obstacles that move.
        limits: Limits of motions.
        stopping: Limits of stops.
        settings: Parameters of the loop.
        make: Makes the way of replanning; a function or class of a module.
        arguments: Its arguments.
        seed: Of random choices.
        rehearses: Whether it makes replans of all sorts before it is ready, so that no code is loaded later.
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
    """Replans made by a process of its own; one that dies is made anew.

    As a context manager it waits until the process is ready, and ends it.

    Attributes:
        process: The process.
        restarts: How often it was made anew.
    """

    def __init__(self, work: Work, core: int | None = None) -> None:
        """Start a process.

        Args:
            work: What it is to do.
            core: Processor core that it keeps to; any by default.
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
        if self._core is not None:  # not behind its imports: it begins where this thread is kept to
            with suppress(OSError):
                os.sched_setaffinity(self.process.pid, {self._core})
        self._connection: Connection[Any, Any] = mine
        self._ready = False
        self._asked: list[float] = []
        self._send((sys.path, self._core, pickle.dumps(self._work)))

    def __enter__(self) -> Self:
        """Wait until it is ready.

        Raises:
            PlannerProcessError: It could not be made ready.
        """
        try:
            if not self._connection.poll(STARTED):
                raise PlannerProcessError(f"the planner process was not ready within {STARTED:g} s")
            self._take(self._connection.recv())
        except (EOFError, OSError) as error:
            self.close()
            raise PlannerProcessError("the planner process died while it was made ready") from error
        except BaseException:  # Ctrl-C among them
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""
        self.close()

    def _take(self, said: str) -> None:
        if said:
            raise PlannerProcessError(f"the planner process could not be made ready: {said}")
        self._ready = True

    def submit(self, request: Request) -> bool:
        """Send a request, which ends what the process is busy with; return whether it was sent.

        It is not where the process is not there, or one waits already.
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
        """Send a message as it is now from a thread: a process that does not read holds up who writes."""
        self._sender = threading.Thread(target=_sent, args=(self._connection, pickle.dumps(message)), daemon=True)
        self._sender.start()

    def reply(self, now: float) -> Reply | None:
        """Return the newest answer that has come, if any; a process that has been busy for ``HUNG`` is made anew."""
        del now
        newest = None
        if self._asked and time.monotonic() > self._asked[0] + HUNG:
            self._replace("did not answer")
        try:
            while self._connection.poll():
                said = self._connection.recv()
                if isinstance(said, str):
                    self._take(said)
                else:
                    newest = said
                    del self._asked[:1]
            if self.process.poll() is not None:  # a child of its own may still hold the connection open
                self._replace("died")
        except (EOFError, OSError):
            self._replace("died")
        except PlannerProcessError as error:
            self._faults.append(str(error))
        return newest

    def faults(self) -> tuple[str, ...]:
        """Return what went wrong since the last call."""
        found, self._faults = tuple(self._faults), []
        return found

    def _replace(self, why: str) -> None:
        """Make the process anew."""
        self._faults.append(f"the planner process {why}")
        self.close(wait=0.0)
        self.restarts += 1
        self._start()

    def close(self, wait: float = ENDED) -> None:
        """End the process, by force where it goes on for some time [s]."""
        self._ready = False
        self._sender.join(wait)
        if self._sender.is_alive():
            self.process.kill()
            self._sender.join()
        self._connection.close()  # not before: what is still being sent would go to whatever gets its number
        try:
            self.process.wait(wait)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _sent(connection: Connection[Any, Any], message: bytes) -> None:
    """Send a message to a process that may not read it; where it has died, the next look at its answers says so."""
    with suppress(OSError):
        connection.send_bytes(message)
