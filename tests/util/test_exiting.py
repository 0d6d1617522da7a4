"""The end of the interpreter while daemon threads are inside of OMPL, in a process of its own each."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from apex_ompl.util import exiting

PLANS = """
import sys, threading, time, apex_ompl
from apex_ompl import planners
from ompl import util as ou
ou.setLogLevel(ou.LogLevel.LOG_NONE)
problem, begun = apex_ompl.load_problem("shelf/extreme/900003"), threading.Event()
def plan():
    begun.set()
    while True: apex_ompl.plan(problem, planner=sys.argv[1], timeout=600)
def solve():
    setup = apex_ompl.setup(problem)
    setup.setPlanner(planners.make(sys.argv[1], setup.getSpaceInformation()))
    setup.setStateValidityChecker(lambda state: begun.set() or len(state[0:16]) == 16 and abs(state[0] - 0.3) > 0.2)
    while True: setup.solve(600.0), setup.clear()
threading.Thread(target={sys.argv[2]}, daemon=True).start()
begun.wait()
time.sleep(1.0)
print("the main thread ends")
"""


@pytest.mark.parametrize(("planner", "how"), [("apex", "plan"), ("rrtstar", "solve")])
def test_the_process_ends_in_order_while_a_daemon_thread_plans(planner: str, how: str) -> None:
    script = PLANS.replace("{sys.argv[2]}", how)
    ended = subprocess.run(
        [sys.executable, "-c", script, planner], check=False, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    assert "the main thread ends" in ended.stdout and "Fatal" not in ended.stderr


def test_what_runs_is_told_to_end_and_waited_for() -> None:
    work, told, left = exiting._Work(), threading.Event(), threading.Event()

    def runs() -> None:
        with work.running(told.set):
            with work.running(lambda: None):
                told.wait(30.0)
            left.set()

    thread = threading.Thread(target=runs, daemon=True)
    thread.start()
    while not work._ends:
        pass
    work.end()
    assert told.is_set() and left.is_set() and not work._ends
    assert thread.is_alive(), "it stands still, and does not come back to what called it"
    with work.running(lambda: None):
        pass  # a thread that is no daemon goes on


def test_a_daemon_thread_begins_nothing_any_more() -> None:
    work, begun = exiting._Work(), threading.Event()
    work.end()

    def runs() -> None:
        with work.running(lambda: None):
            begun.set()

    thread = threading.Thread(target=runs, daemon=True)
    thread.start()
    assert not begun.wait(0.1) and thread.is_alive()


COMMAND = """
import atexit, sys, threading, time
from apex_ompl.util import exiting

def slow():
    time.sleep(0.3)
    print("the thread")

atexit.register(print, "the exit function")
threading.Thread(target=slow).start()
class Freed:
    def __del__(self):
        print("freed")
kept = Freed()
kept.self = kept  # freed by the interpreter's end alone
code = exiting.end_quickly(int(sys.argv[1]))
print("the command")
{last}
"""


@pytest.mark.parametrize(("last", "freed"), [("sys.exit(code)", False), ("exiting._stay(); sys.exit(code)", True)])
@pytest.mark.parametrize("code", [0, 3])
def test_a_quick_end_waits_for_threads_and_exit_functions(code: int, last: str, freed: bool) -> None:
    script = COMMAND.replace("{last}", last)
    command = [sys.executable, "-c", script, str(code)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert ended.returncode == code and not ended.stderr
    lines = ended.stdout.splitlines()
    assert lines[:3] == ["the command", "the thread", "the exit function"]
    assert ("freed" in lines) is freed


def test_a_quick_end_whose_output_nobody_reads_says_so() -> None:
    script = "import sys; from apex_ompl.util import exiting; print('x' * 9); sys.exit(exiting.end_quickly(0))"
    command = ["bash", "-c", f'unset PYTHONUNBUFFERED; {sys.executable} -c "{script}" > /dev/full']
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 120 and "No space left" in ended.stderr
