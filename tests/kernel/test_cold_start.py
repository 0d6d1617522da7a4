"""The first plan of a process: what is loaded or compiled, and when, with the library of the kernel and without."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from apex_ompl.kernel.compiled.entry_points import PLANS, RUNS, Group
from apex_ompl.kernel.library import CHOICE

SCRIPT = """
import sys
from contextlib import contextmanager
from apex_ompl import plan
from apex_ompl.kernel.compiled import jit
from apex_ompl.util.deadline import Deadline

late, running = [], False
begin, paused, original = Deadline.__init__, Deadline.paused, jit.CompiledFunction.__call__

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

Deadline.__init__, Deadline.paused, jit.CompiledFunction.__call__ = started, stopped, called
result = plan("shelf/hard/800000", sys.argv[1], timeout=30.0)
print(result.status, late)
"""


@pytest.mark.parametrize("planner", ["apex", "rrtconnect+polish"])
def test_no_code_is_loaded_or_compiled_while_the_time_limit_runs(planner: str) -> None:
    """On a new machine a compilation takes longer than the limit, so that the first plan would be out of time."""
    command = [sys.executable, "-c", SCRIPT, planner]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
    assert done.stdout.strip() == "EXACT_SOLUTION []", done.stdout + done.stderr


TYPES = """
import numpy as np
from numba.core.sigutils import normalize_signature
from apex_ompl import filter_points, load_robot, plan, run
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.kernel.compiled.entry_points import PLANS, RUNS
from apex_ompl.kernel.group_compilation import _function
from apex_ompl.kernel.library import is_used

assert plan("shelf/hard/800000", timeout=30.0)
assert plan("vertical/large/800000", timeout=30.0, params={"line": False}).solved_by == "sprint"
for world in ("vertical/moving-huge-0.4/800007", "turning/vertical/large/800000"):
    run(world, settings=LoopSettings(timeout=1.5))
robot = load_robot("dual_panda_softhand")
assert len(filter_points(np.random.default_rng(0).uniform(-1.0, 1.0, (1000, 3)), robot, robot.home)) < 1000
for name, (types, _) in () if is_used() else {**PLANS.functions, **RUNS.functions}.items():
    found = _function(name).dispatcher.signatures
    assert found == [normalize_signature(f"({types},)")[0]], (name, found)
print("as declared")
"""


def test_functions_are_called_with_the_types_that_they_were_compiled_for() -> None:
    """Others would be compiled again, or refused by the library."""
    done = subprocess.run([sys.executable, "-c", TYPES], check=False, capture_output=True, text=True, timeout=300)
    assert done.stdout == "as declared\n", done.stderr


FEW = """
import sys
from apex_ompl.kernel import group_compilation
from apex_ompl.kernel.compiled.entry_points import PLANS, Group
from apex_ompl.kernel.compiled.jit import names_in_cache

some = ("timing.time_parameterization.sample_times", "check.motion_proof.lay_grid")
parts = tuple({name: PLANS.functions[name]} for name in some)
group = Group("two functions", 1, parts)
group_compilation.CHILD = sys.argv[1] or group_compilation.CHILD
group_compilation.compile_group(group)
assert names_in_cache() == {"sample_times", "lay_grid"}, names_in_cache()
group_compilation.compile_group(group)
"""


@pytest.mark.parametrize("group", [PLANS, RUNS], ids=["plans", "runs"])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_all_functions_are_compiled_by_as_many_processes_as_there_are_cores(group: Group, count: int) -> None:
    shares = group.shares(count)
    assert len(shares) == min(count, len(group.parts)) and all(shares)
    assert [name for share in shares for name in share] == list(group.functions)
    seconds = [sum(group.functions[name][1] for name in share) for share in shares]
    assert max(seconds) <= 1.7 * sum(seconds) / len(shares)


@pytest.mark.parametrize("child", ["", "raise SystemExit(1)"], ids=["beside", "alone"])
def test_the_kernel_is_compiled_in_several_processes_or_in_one(tmp_path: Path, child: str) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), CHOICE: "numba"}
    command = [sys.executable, "-c", FEW, child]
    first, second = (
        subprocess.run(command, env=environment, check=False, capture_output=True, text=True, timeout=120)
        for _ in range(2)
    )
    assert first.returncode == second.returncode == 0, first.stderr + second.stderr
    assert first.stderr.count("apex_ompl compile") == 2 and str(tmp_path) in first.stderr
    assert second.stderr == ""
