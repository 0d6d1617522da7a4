"""``os.fork`` while other threads prepare plans, in a process of its own each: no lock stays shut in the child."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest

from apex_ompl.util.forking import ProcessLock, unforked

FIRST_PLAN = """
import os, sys, threading, time, apex_ompl
def plans(): apex_ompl.plan("shelf_swap", sys.argv[1], timeout=1.0)
threading.Thread(target=plans, daemon=True).start()
time.sleep(float(sys.argv[2]))
child = os.fork()
if not child:
    os._exit(0 if apex_ompl.plan("ball_in_cup", sys.argv[1], timeout=20.0) else 1)
for _ in range(600):
    done, status = os.waitpid(child, os.WNOHANG)
    if done: break
    time.sleep(0.1)
else: os.kill(child, 9)
os._exit(os.waitstatus_to_exitcode(status) if done else 99)
"""


@pytest.mark.parametrize(("planner", "after"), [("rrtconnect+polish", 0.05), ("apex", 1.0)])
def test_a_child_plans_while_its_parent_prepares_its_first_plan(planner: str, after: float) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", FIRST_PLAN, planner, str(after)], check=False, capture_output=True, text=True,
        timeout=150,
    )  # fmt: skip
    assert ended.returncode == 0, (ended.returncode, ended.stderr)


IMPORTS = """
import sys, threading, apex_ompl
from apex_ompl.util import forking
unsafe = []
class Finder:
    def find_spec(self, name, path=None, target=None):
        if threading.get_ident() not in forking._gate._preparing: unsafe.append(name)
sys.meta_path.insert(0, Finder())
def line():
    planner = apex_ompl.MotionPlanner("dual_panda_softhand")
    start = planner.robot.home
    return planner.plan_line(start, (0.31, 0.44, 0.49), frame="left_hand", timeout=20.0)
def among():
    ball = apex_ompl.Obstacle(name="ball", sphere={"radius": 0.05}, position=(0.9, 0.0, 1.2), velocity=(0.1, 0.0, 0.0))
    problem = apex_ompl.load_problem("shelf_swap")
    return apex_ompl.plan(problem.model_copy(update={"scene": (*problem.scene, ball)}), timeout=20.0)
assert eval(sys.argv[1])
sys.exit(f"imported while a fork would not wait: {unsafe}" if unsafe else 0)
"""


@pytest.mark.parametrize(
    "plan",
    [
        "apex_ompl.plan('shelf_swap')", "apex_ompl.plan('carry_tray')", "line()", "among()",
        "apex_ompl.plan('shelf_swap', 'rrtconnect+polish', objective='calm')",
    ],
)  # fmt: skip
def test_what_plans_import_is_imported_while_forks_wait(plan: str) -> None:
    """A fork in the middle of an import leaves its lock shut in the child, which then waits for ever."""
    ended = subprocess.run([sys.executable, "-c", IMPORTS, plan], check=False, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def exit_code_of_child(work: Callable[[], bool]) -> int:
    """What a forked child makes of some work; 9 where it took too long."""
    child = os.fork()
    if not child:
        os._exit(0 if work() else 1)
    for _ in range(500):
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, 9)
    return -os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_locks_of_other_threads_are_open_in_a_child() -> None:
    lock, held, free = ProcessLock(), threading.Event(), threading.Event()

    def holds() -> None:
        with lock:
            held.set()
            free.wait(30.0)

    def takes() -> bool:
        with lock:
            return True

    thread = threading.Thread(target=holds)
    thread.start()
    held.wait()
    try:
        assert exit_code_of_child(takes) == 0
    finally:
        free.set()
        thread.join()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_fork_waits_for_what_is_prepared() -> None:
    order, begun = list[str](), threading.Event()

    @unforked()
    def prepares() -> None:
        begun.set()
        time.sleep(0.2)
        order.append("prepared")

    thread = threading.Thread(target=prepares)
    thread.start()
    begun.wait()
    with unforked():  # of the thread itself it does not wait
        assert exit_code_of_child(lambda: order == ["prepared"]) == 0
    thread.join()
    assert exit_code_of_child(lambda: True) == 0
