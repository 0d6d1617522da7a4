"""What a whole call takes: in a fresh process, by ``plan``, by a kept planner, after an obstacle moved.

Test problems are planned by the default planner, with timing, one at a time. ``plan`` and the kept planner are warm:
one problem of another kind was planned before. The kept planner has the problem's world already; in the last row an
obstacle is moved by a millimeter first, which counts. Times are those of the whole call, with set-up, proof and timing;
``beside solve`` is what is not spent in the planner's ``solve``. A fresh process runs
``apex-ompl plan NAME``, with the compiled code in its cache. RoboPlan's row, with its tuned range, where RoboPlan is
there and has the shapes: its scene is built, it plans and shortens, and nothing is proved or timed.

Usage: python -m benchmarks.planners.session [-n 100] [--fresh 20]
"""

from __future__ import annotations

import math
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec

from apex_ompl import MotionPlanner, PlanResult, load_problem, plan, problems
from apex_ompl.ompl.process import quiet_ompl
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.problems.suite_robot import robot
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/planning", "apex_ompl/cli")
LEVELS = ("shelf/hard", "vertical/medium", "clutter/medium")
WARM_UP = "wall/easy/800000"
STEP = 0.001  # by which an obstacle is moved [m]
TIMEOUT = 10.0  # [s]
Call = Callable[[], PlanResult]


def fresh(name: str) -> tuple[float, float, bool]:
    """Return the wall time of a process that plans a problem, what it took beside solve, and whether it solved it."""
    command = [sys.executable, "-m", "apex_ompl.cli", "plan", name, "--timeout", str(TIMEOUT)]
    begin = time.perf_counter()
    done = subprocess.run(command, check=False, capture_output=True)
    return time.perf_counter() - begin, float("nan"), done.returncode == 0


def measured(call: Call) -> tuple[float, float, bool]:
    """Return the time of a call, what of it was not spent in ``solve``, and whether it found a path."""
    begin = time.perf_counter()
    result = call()
    total = time.perf_counter() - begin
    return total, total - result.times.get("solve", 0.0), bool(result)


def by_roboplan(name: str) -> tuple[float, float, bool]:
    """Return the same of RoboPlan's whole call."""
    from roboplan.core import JointConfiguration, PathShortcutter, PathShortcuttingOptions
    from roboplan.rrt import RRT, RRTOptions

    from benchmarks.planners import peers

    ready = assemble(load_problem(name), robot())
    begin = time.perf_counter()
    scene = peers.roboplan_scene(ready)
    options = RRTOptions(
        max_nodes=peers.NODES, collision_check_step_size=SEARCH_RESOLUTION, max_planning_time=TIMEOUT,
        rrt_connect=True, **TUNED["roboplan"],
    )  # fmt: skip
    planner, joints = RRT(scene, options), list(scene.getJointNames())
    planner.setRngSeed(0)
    ends = [JointConfiguration(joints, ready.robot.to_pinocchio(q)) for q in (ready.start, ready.goals[0])]
    began = time.perf_counter()
    try:
        found = planner.plan(*ends)
    except RuntimeError:
        return time.perf_counter() - begin, math.nan, False
    solve = time.perf_counter() - began
    PathShortcutter(scene, PathShortcuttingOptions(max_step_size=SEARCH_RESOLUTION, seed=0)).shortcut(found)
    total = time.perf_counter() - begin
    return total, total - solve, True


def roboplan_plans(name: str) -> bool:
    """Whether RoboPlan is there and has the shapes of a problem."""
    if find_spec("roboplan") is None:
        return False
    from benchmarks.planners import peers

    return peers.representable(load_problem(name))


def move_and_plan(planner: MotionPlanner, problem: Problem) -> PlanResult:
    """Move the first obstacle up and plan."""
    name, body = next(iter(planner.world.obstacles.items()))
    x, y, z = body.position
    planner.world.move(name, (x, y, z + STEP))
    return plan_again(planner, problem)


def plan_again(planner: MotionPlanner, problem: Problem) -> PlanResult:
    """Plan from the start of a problem to its goal in the world as it is."""
    return planner.plan(problem.start, problem.goal, timeout=TIMEOUT)


def measure(names: list[str], fresh_names: list[str]) -> dict[str, list[tuple[float, float, bool]]]:
    """Return the measurements of a level by row."""
    rows: dict[str, list[tuple[float, float, bool]]] = {"fresh process": [fresh(name) for name in fresh_names]}
    rows |= {"plan(problem)": [], "kept planner": [], "kept planner, an obstacle moved": []}
    with MotionPlanner() as planner:
        plan(WARM_UP)
        planner.plan_problem(load_problem(WARM_UP))
        for name in names:
            problem = load_problem(name)
            rows["plan(problem)"].append(measured(lambda problem=problem: plan(problem, timeout=TIMEOUT)))  # type: ignore[misc]
            planner.world.load(problem)
            plan_again(planner, problem)
            rows["kept planner"].append(measured(lambda problem=problem: plan_again(planner, problem)))  # type: ignore[misc]
            moved = measured(lambda problem=problem: move_and_plan(planner, problem))  # type: ignore[misc]
            rows["kept planner, an obstacle moved"].append(moved)
    rows["RoboPlan"] = [by_roboplan(name) for name in names if roboplan_plans(name)]
    return {row: values for row, values in rows.items() if values}


def main() -> None:
    """Measure and write the table."""
    parser = record.parser(__doc__)
    parser.add_argument("-n", type=one_or_more, default=100, metavar="N", help="problems of a level")
    parser.add_argument("--fresh", type=one_or_more, default=20, metavar="N", help="of them in fresh processes")
    args = parser.parse_args()
    lines = [["level", "", "N", "solved", "p50 ms", "p95 ms", "beside solve p50 ms", "p95 ms"]]
    lines.append(["---", "---", *["---:"] * 6])
    found = {}
    with quiet_ompl():
        for level in LEVELS:
            names = list(problems.frozen_names(*level.split("/")))[: args.n]
            found[level] = measure(names, names[: args.fresh])
            for row, values in found[level].items():
                total, beside, solved = zip(*values, strict=True)
                times = [*record.percentiles(total, 50, 95), *record.percentiles(beside, 50, 95)]
                shown = ["-" if math.isnan(value) else f"{1e3 * value:.0f}" for value in times]
                lines.append([level, row, str(len(values)), f"{sum(solved) / len(values):.2f}", *shown])
    table = "\n".join(record.row(line) for line in lines)
    record.write("session", {"calls": found}, table, n=args.n, split="test", timeout=TIMEOUT, seed=0)


if __name__ == "__main__":
    run_script(main)
