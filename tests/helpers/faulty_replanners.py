"""Replanners that fail, for processes of their own: straight lines at first, then something else."""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import Any

from loops import line

from apex_ompl.moving.compute_costs import ComputeBudget
from apex_ompl.moving.context import Following, RunContext
from apex_ompl.moving.replanner import Answer, Request


class Faulty:
    """A straight line, and then faults in turn, the last one for ever."""

    def __init__(self, *faults: str) -> None:
        self.faults, self.calls, self.modules = faults, 0, set[str]()

    def prepare(self, context: RunContext) -> None:
        del context
        self.modules = {*sys.modules}

    def replan(self, context: RunContext, request: Request, budget: ComputeBudget) -> Any:
        fault = ("", *self.faults)[min(self.calls, len(self.faults))]
        self.calls += 1
        if fault == "orphaned" and os.fork() == 0:  # a child that holds the connection open
            time.sleep(15.0)
            os._exit(0)
        if fault in ("killed", "orphaned"):
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "never":
            time.sleep(3600.0)
        while fault == "busy" and not budget.over():
            time.sleep(0.001)
        if fault == "late":
            time.sleep(0.2)
        if fault == "imports" and (new := {*sys.modules} - self.modules):
            raise ValueError(f"imported since: {new}")
        if fault == "raises":
            raise ValueError("a bad number")
        if fault == "nonsense":
            return Answer(Following(line(context, request).motion, request.join + 1.0), "nonsense", budget)
        return Answer(line(context, request), "line", budget)
