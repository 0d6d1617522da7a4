"""The first plan of a process: what is loaded or compiled, and when."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
import sys
from contextlib import contextmanager
from apex_ompl import plan
from apex_ompl.kernel.compiled import compilation
from apex_ompl.util.deadline import Deadline

late, running = [], False
begin, paused, original = Deadline.__init__, Deadline.paused, compilation._Announced.__call__

def started(self, timeout):
    global running
    begin(self, timeout)
    running = True

@contextmanager
def stopped(self):
    global running
    running = False
    with paused(self):
        yield
    running = True

def called(self, *arguments):
    if running and not self._ready:
        late.append(self.name)
    return original(self, *arguments)

Deadline.__init__, Deadline.paused, compilation._Announced.__call__ = started, stopped, called
result = plan("shelf/hard/800000", sys.argv[1], timeout=30.0)
print(result.status, late)
"""


@pytest.mark.parametrize("planner", ["apex", "rrtconnect+polish"])
def test_no_code_is_loaded_or_compiled_while_the_time_limit_runs(planner: str) -> None:
    """On a new machine a compilation takes longer than the limit, so that the first plan would be out of time."""
    command = [sys.executable, "-c", SCRIPT, planner]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.stdout.strip() == "EXACT_SOLUTION []", done.stdout + done.stderr
