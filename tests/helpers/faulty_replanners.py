"""Replanners that fail, for processes of their own: straight lines at first, then something else."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

from loops import line

from apex_ompl.moving.charges import Charges
from apex_ompl.moving.following import Following
from apex_ompl.moving.ready import Ready
from apex_ompl.moving.request import Answer, Request


class Faulty:
    """A straight line, and then faults in turn, the last one for ever."""

    def __init__(self, *faults: str) -> None:
        self.faults, self.calls = faults, 0

    def prepare(self, ready: Ready) -> None:
        del ready

    def replan(self, ready: Ready, request: Request, charges: Charges) -> Any:
        fault = ("", *self.faults)[min(self.calls, len(self.faults))]
        self.calls += 1
        if fault == "orphaned" and os.fork() == 0:  # a child that holds the connection open
            time.sleep(15.0)
            os._exit(0)
        if fault in ("killed", "orphaned"):
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "never":
            time.sleep(3600.0)
        while fault == "busy" and not charges.over():
            time.sleep(0.001)
        if fault == "late":
            time.sleep(0.2)
        if fault == "raises":
            raise ValueError("a bad number")
        if fault == "nonsense":
            return Answer(Following(line(ready, request).motion, request.join + 1.0), "nonsense", charges)
        return Answer(line(ready, request), "line", charges)
