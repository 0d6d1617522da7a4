"""Whether APEX stands what users do to a planner: threads, processes, thousands of solves, hopeless problems.

Every row says what came out and what was expected; the command fails where they differ.

Usage: python -m benchmarks.planners.robustness [--solves 10000]
"""

from __future__ import annotations

import gc
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl import plan, problems
from apex_ompl.apex.parameters import ApexParameters
from apex_ompl.apex.planner import APEX
from apex_ompl.errors import ApexError
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.space import to_state
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@planning",)
HARD = "shelf/hard/800012"
MIB = 2**20
OVERRUN = 0.02  # that is aimed at [s]
GROWTH = 16.0  # of resident memory that is let pass between the middle and the end [MiB]


def resident() -> float:
    """Return this process's resident memory [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / MIB


def lengths(seed: int) -> float:
    """Return the length of a plan with a seed."""
    return plan(HARD, timeout=60.0, params={"seed": seed}).length


def in_threads() -> tuple[str, bool]:
    """Two plans in two threads come to what each comes to alone."""
    alone = [lengths(seed) for seed in (1, 2)]
    with ThreadPoolExecutor(2) as pool:
        there = list(pool.map(lengths, (1, 2)))
    return f"lengths {there}", there == alone


def in_processes() -> tuple[str, bool]:
    """Eight plans in eight processes come to the same."""
    with ProcessPoolExecutor(8, multiprocessing.get_context("spawn")) as pool:
        there = list(pool.map(lengths, [1] * 8))
    return f"{len(set(there))} length(s)", set(there) == {lengths(1)}


def many(count: int) -> tuple[str, bool]:
    """Thousands of solves in one process leave its memory as it was."""
    ready = assemble(problems.load(HARD), robot())
    setup = ready.simple_setup
    planner = APEX(setup.getSpaceInformation(), ApexParameters(polish=False))
    setup.setPlanner(planner)
    marks, solved, begin = [], 0, time.perf_counter()
    for k in range(count):
        setup.clear()
        solved += setup.solve(ob.timedPlannerTerminationCondition(10.0)).getStatus() == ob.PlannerStatus.EXACT_SOLUTION
        if (k + 1) % (count // 4) == 0:
            gc.collect()
            marks.append(resident())
    took = time.perf_counter() - begin
    outcome = f"{solved} solved in {took:.0f} s, MiB at quarters: {', '.join(f'{m:.0f}' for m in marks)}"
    return outcome, solved == count and marks[-1] - marks[1] < GROWTH


def overruns() -> tuple[str, bool]:
    """How long solve goes on after its time limit, at all moments of its work, on problems of all suites."""
    late = []
    for suite in ("shelf", "cage", "clutter", "swap", "posts", "wall", "bins"):
        for name in problems.frozen_names(suite, "hard", "validation")[:6]:
            ready = assemble(problems.load(name), robot())
            setup = ready.simple_setup
            planner = APEX(setup.getSpaceInformation(), ApexParameters(seed=0, anytime=True))
            setup.setPlanner(planner)
            setup.setup()
            for limit in (0.001, 0.01, 0.03, 0.1, 0.3):
                setup.clear()
                begin = time.perf_counter()
                planner_status = setup.solve(ob.timedPlannerTerminationCondition(limit))
                late.append(max(0.0, time.perf_counter() - begin - limit))
                assert planner_status.getStatus() != ob.PlannerStatus.CRASH
    found = np.array(late)
    outcome = f"N = {len(found)}, ms p50 {1e3 * np.median(found):.1f}, p95 {1e3 * np.percentile(found, 95):.1f}, "
    return outcome + f"most {1e3 * found.max():.1f}", bool(found.max() < OVERRUN)


def walled() -> Problem:
    """A wall that begins 12 cm from the left arm's first axis: its first link cannot turn past it, and must."""
    panda = robot()
    start, goal = panda.home.copy(), panda.home.copy()
    start[0], goal[0] = 0.6, 2.12
    wall = Obstacle(name="wall", box=(2.0, 0.04, 3.0), position=(1.12, 0.5, 1.5))

    def named(q: np.ndarray) -> dict[str, float]:
        return dict(zip(panda.joint_names, q.tolist(), strict=True))

    return Problem(name="walled", robot=panda.name, scene=(wall,), start=named(start), goal=Goal(joints=(named(goal),)))


def hopeless() -> tuple[str, bool]:
    """No way to the goal: TIMEOUT, on time."""
    result = plan(walled(), timeout=3.0)
    late = result.times.get("solve", 0.0) - 3.0
    return f"{result.status} after {result.times.get('solve', 0.0):.3f} s: {result.reason}", (
        str(result.status) == "TIMEOUT" and -0.1 < late < OVERRUN
    )


def changed(**changes: Any) -> Problem:
    """Return the hard problem with changes."""
    return problems.load(HARD).model_copy(update=changes)


def at_goal() -> tuple[str, bool]:
    """Start and goal are one."""
    base = problems.load(HARD)
    result = plan(changed(goal=Goal(joints=(dict(base.start),))), timeout=5.0)
    return f"{result.status}, {result.length:.3f} rad", bool(result) and result.length == 0.0


def goal_in_collision() -> tuple[str, bool]:
    """The goal collides."""
    panda, ready = robot(), assemble(problems.load(HARD), robot())
    rng = np.random.default_rng(0)
    drawn = (rng.uniform(panda.limits.lower, panda.limits.upper) for _ in range(1000))
    q = next(q for q in drawn if not ready.checker.is_free(q))
    joints = dict(zip(panda.joint_names, q.tolist(), strict=True))
    result = plan(changed(goal=Goal(joints=(joints,))), timeout=5.0)
    return f"{result.status}: {result.reason}", str(result.status) == "INVALID_GOAL" and bool(result.reason)


def in_a_millisecond() -> tuple[str, bool]:
    """Next to no time."""
    result = plan(HARD, timeout=0.001)
    late = result.times["solve"] - 0.001
    outcome = f"{result.status} after {1e3 * result.times['solve']:.1f} ms"
    return outcome, str(result.status) == "TIMEOUT" and late < OVERRUN


def nan_in_a_state() -> tuple[str, bool]:
    """A start with NaN, past all checks of files."""
    ready = assemble(problems.load(HARD), robot())
    si = ready.simple_setup.getSpaceInformation()
    start, pdef = ready.start.copy(), ob.ProblemDefinition(si)
    start[4] = np.nan
    pdef.setStartAndGoalStates(*(to_state(si, q) for q in (start, ready.goals[0])))
    planner = APEX(si)
    planner.setProblemDefinition(pdef)
    status = planner.solve(ob.timedPlannerTerminationCondition(1.0)).getStatus()
    return f"{status.name}: {planner.report.reason}", status == ob.PlannerStatus.INVALID_START


def no_checkpoint() -> tuple[str, bool]:
    """A checkpoint that is not there."""
    try:
        plan(HARD, params={"model": "no/such/folder"})
    except ApexError as error:
        return str(error), "no/such/folder" in str(error)
    return "no error", False


def pieces(count: int) -> Callable[[], tuple[str, bool]]:
    """So many obstacles."""

    def check() -> tuple[str, bool]:
        rng = np.random.default_rng(0)
        scene = []
        for k in range(count):
            place = (float(rng.uniform(-1.5, -0.9)), float(rng.uniform(-1, 1)), float(rng.uniform(0, 1.5)))
            scene.append(Obstacle(name=f"piece{k}", box=(0.03, 0.03, 0.03), position=place))
        base = problems.load(HARD)
        result = plan(changed(scene=(*scene, *base.scene) if count else ()), timeout=10.0)
        return f"{result.status} by {result.solved_by} in {1e3 * result.times.get('solve', 0.0):.0f} ms", bool(result)

    return check


def main() -> None:
    """Do all of it."""
    parser = record.parser(__doc__)
    parser.add_argument("--solves", type=one_or_more, default=10_000)
    args = parser.parse_args()
    checks: dict[str, Callable[[], tuple[str, bool]]] = {
        "two plans in two threads": in_threads, "eight plans in eight processes": in_processes,
        "start is the goal": at_goal, "goal in collision": goal_in_collision, "no way to the goal": hopeless,
        "timeout of 1 ms": in_a_millisecond, "no obstacles": pieces(0), "300 more obstacles": pieces(300),
        "no such checkpoint": no_checkpoint, "NaN in the start": nan_in_a_state, "time over the limit": overruns,
        f"{args.solves} solves": lambda: many(args.solves),
    }  # fmt: skip
    rows, failed = [record.row(["what", "what came out", "as expected"]), record.row(["---", "---", "---"])], []
    found = {}
    with quiet_ompl():
        plan(HARD)
        for name, check in checks.items():
            outcome, good = check()
            print(f"{name}: {outcome} {'' if good else '<-- not as expected'}", flush=True)
            rows.append(record.row([name, outcome, "yes" if good else "no"]))
            found[name] = {"outcome": outcome, "as_expected": good}
            failed += [] if good else [name]
    record.write("robustness", {"checks": found}, "\n".join(rows), seed="0 or as stated")
    if failed:
        sys.exit(f"not as expected: {', '.join(failed)}")


if __name__ == "__main__":
    run_script(main)
