"""Sequences in random cells: pick and place with 50 grasps, a handover, and three boxes stacked with both hands.

Each cell is planned as a whole, without going back (the nearest goal of each motion is taken, and the cell is lost
where it does not suit the later steps), without blends, as MoveIt does it, with OMPL's RRTConnect for
the motions between the same stages, and with steps of both arms at once. Times are processor times of one process with
a kept planner, without the first cell of each kind. What a cell loads stays loaded for the rows after the first, so
that rows come first by turns. First cells are planned in a new process each, ten of a kind, without the time of
imports. Each run is stored in benchmarks/runs/cells when it
ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.cells [-n 100] [--first 1000] [--timeout 60] [--kind stacking]
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

from apex_ompl import MotionPlanner
from apex_ompl.planning import TaskSearch
from apex_ompl.problems import cells
from apex_ompl.scene.problem import Problem
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import whole_number
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/constraints")
FOLDER = record.RESULTS.parent / "runs" / "cells"
RIVAL = "rrtconnect+polish"
ROWS = {
    "sequence": TaskSearch(), "without going back": TaskSearch(goes_back=False), "without blends": TaskSearch(),
    RIVAL: TaskSearch(), "asynchronous": TaskSearch(asynchronous=True),
}  # fmt: skip
COMPARED = "sequence", "without blends"  # by their makespans
MOST_CAUSES = 4  # that a table names
FIRST = "first"  # row of cells that are planned in a new process
FRESH = 10  # of them


def without_blends(problem: Problem) -> Problem:
    """Return a cell in which the robot rests between all steps."""
    steps = [
        step.model_copy(update={"blend": None}) if "blend" in type(step).model_fields else step
        for step in problem.after
    ]  # fmt: skip
    return problem.model_copy(update={"after": tuple(steps)})


def made(planner: MotionPlanner, kind: str, row: str, seed: int, timeout: float) -> dict[str, Any]:
    """Return what a run of a cell gave."""
    cell = cells.draw(kind, seed)
    cell = without_blends(cell) if row == "without blends" else cell
    begin = time.process_time()
    search, name = ROWS.get(row, TaskSearch()), RIVAL if row == RIVAL else None
    result = planner.plan_task(cell, name, timeout=timeout, seed=seed, search=search)
    spent = time.process_time() - begin
    return {
        "kind": kind, "row": row, "seed": seed, "solved": bool(result), "status": str(result.status), "cpu_s": spent,
        "makespan_s": None if result.trajectory is None else result.trajectory.duration,
        "examined": result.goals_examined, "rejected": dict(result.goals_rejected),
        "commit": record.session()["commit"], "blends": sum(step.blended for step in result.steps),
        "clearance_m": _clearance(result.motion_clearance),
    }  # fmt: skip


def _clearance(value: float) -> float | None:
    return value if np.isfinite(value) else None


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Return the table of kinds and rows, and what failed how often."""
    head = [
        "cells", "row", "solved", "planning CPU s p50", "p95", "first cells p50", "makespan s p50", "p95",
        "choices examined p50",
    ]  # fmt: skip
    lines, causes = [head, ["---", "---", *["---:"] * (len(head) - 2)]], list[str]()
    for kind in dict.fromkeys(run["kind"] for run in runs):
        both = set.intersection(
            *({r["seed"] for r in runs if (r["kind"], r["row"], r["solved"]) == (kind, row, True)} for row in COMPARED)
        )
        for row in ROWS:
            mine = sorted((r for r in runs if (r["kind"], r["row"]) == (kind, row)), key=lambda r: r["seed"])
            spent = record.percentiles([r["cpu_s"] for r in mine[1:]], 50, 95)
            makespans = record.percentiles([r["makespan_s"] for r in mine if r["seed"] in both and r["solved"]], 50, 95)
            examined = record.percentiles([r["examined"] for r in mine], 50)[0]
            fresh = [r["cpu_s"] for r in runs if (r["kind"], r["row"]) == (kind, FIRST)] if row == COMPARED[0] else []
            first = record.percentiles(fresh, 50)[0] if fresh else float("nan")
            solved = f"{sum(r['solved'] for r in mine)}/{len(mine)}"
            times = ["-" if np.isnan(x) else f"{x:.2f}" for x in (*spent, first, *makespans)]
            lines.append([kind, row, solved, *times, f"{examined:.0f}"])
            counts = Counter[str]()
            for run in mine:
                counts.update(run["rejected"])
            named = "; ".join(f"{cause} ({n})" for cause, n in counts.most_common(MOST_CAUSES))
            causes.append(f"- {kind}, {row}: {named or 'nothing'}")
    rows = "\n".join(record.row(line) for line in lines)
    of = "Makespans are of the cells that are solved with and without blends."
    failed = "What failed, by cause and number of choices:"
    return "\n\n".join([rows, f"{of} {failed}", "\n".join(causes)])


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=100, of="cells of a kind")
    parser.add_argument("--first", type=whole_number, default=1000, help="first seed (default: %(default)s)")
    parser.add_argument("--timeout", type=float, default=60.0)
    parser.add_argument("--kind", action="append", choices=cells.names(), default=[])
    args = parser.parse_args()
    kinds, runs = args.kind or cells.names(), list[dict[str, Any]]()
    FOLDER.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for kind, seed in product(kinds, range(args.first, args.first + min(args.n, FRESH))):
            runs.append(_stored(kind, FIRST, seed, lambda *given: pool.submit(first, *given).result(), args.timeout))
    for seed in range(args.first, args.first + args.n):
        turn = seed % len(ROWS)
        for kind in kinds:
            for row in [*ROWS][turn:] + [*ROWS][:turn]:
                runs.append(_stored(kind, row, seed, lambda *given: made(_planner(given[0]), *given), args.timeout))
    seeds, commits = f"{args.first}-{args.first + args.n - 1}", "; ".join(sorted({run["commit"] for run in runs}))
    record.write(
        "cells", {"runs": runs}, table(runs), N=args.n, seeds=seeds, timeout=args.timeout, run_commits=commits
    )  # fmt: skip


def first(kind: str, row: str, seed: int, timeout: float) -> dict[str, Any]:
    """Return what a run gave as the first one of this process."""
    return made(MotionPlanner(cells.draw(kind, seed).robot), kind, row, seed, timeout)


def _stored(kind: str, row: str, seed: int, make: Callable[..., dict[str, Any]], timeout: float) -> dict[str, Any]:
    """Return a run, which is made where its file is missing."""
    file = FOLDER / f"{kind}-{row.replace(' ', '_')}-{seed}.json"
    if not file.exists():
        write_atomically(file, json.dumps(make(kind, row, seed, timeout)).encode())
    found: dict[str, Any] = json.loads(file.read_text())
    return found


_planners: dict[str, MotionPlanner] = {}


def _planner(kind: str) -> MotionPlanner:
    """Return the kept planner of a kind's robot, warm but for its first cell."""
    robot = cells.draw(kind, 0).robot
    if robot not in _planners:
        _planners[robot] = MotionPlanner(robot)
    return _planners[robot]


if __name__ == "__main__":
    run_script(main)
