"""How the executor has its replans made: at once on a simulated clock, or elsewhere on a real one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from apex_ompl.moving.charges import Charges
from apex_ompl.moving.following import Following
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Answer, Replanner, Request

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


def answered(replanner: Replanner, ready: Ready, request: Request, charges: Charges) -> Reply:
    """Return what a way of replanning answers; whatever it raises is a reason."""
    try:
        answer: Any = replanner.replan(ready, request, charges)
        if not isinstance(answer, Answer) or not isinstance(answer.found, Following | None):
            raise TypeError(f"{type(getattr(answer, 'found', answer)).__name__} is no answer")
    except Exception as error:  # whatever a way of replanning does, the robot goes on or stops
        return Reply(request.number, Answer(None, "", charges), f"{type(error).__name__}: {error}")
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
class AtOnce:
    """Replans made when they are asked for, whose answers are known when the work would be done by the table of costs.

    Attributes:
        ready: The robot among what stands still.
        replanner: The way of replanning.
    """

    ready: Ready
    replanner: Replanner
    _known: float = 0.0
    _reply: Reply | None = None

    def submit(self, request: Request) -> bool:
        """Make a replan."""
        settings = self.ready.settings
        busy = self._reply is not None and request.asked < self._known - 1e-9
        charges = Charges(SHARE * settings.budget, NOTICED if busy else 0.0)
        self._reply = answered(self.replanner, self.ready, request, charges)
        self._known = request.asked + (charges.spent if settings.latency < 0.0 else settings.latency)
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
