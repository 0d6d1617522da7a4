"""How hard the suites are: the straight line on all levels, and rrtconnect and rrt among moving obstacles.

Planners on levels without moving obstacles are compared by head_to_head.py. On levels with moving obstacles planners
see the scene of time 0, and their path is followed at a quarter of the velocity limits among the moving obstacles: a
run is solved when nothing is hit. Of those levels 20 test problems are frozen; more are sampled, and may have no
solution. A cube may be where the goal is at time 0; such runs fail, and are counted as ``goal_blocked``.
Each run is stored in benchmarks/runs/calibration when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.calibration [-n 50] [--rrt 20] [--jobs 2] [--store FOLDER] [--report]
    [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.evaluation import Results, Row, Workers, bench, runs
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.moving.timed_proof import check_timed_path, constant_velocity_times
from apex_ompl.problems.alignment import VELOCITY_SCALE
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number
from benchmarks.lib import record

DEPENDS = ("@benchmark", "apex_ompl/moving/timed_proof.py")
FOLDER = record.RESULTS.parent / "runs" / "calibration"
TIMEOUT, LIMITS = 10.0, (0.5, 2.0, 10.0)  # [s]
LINE, PLANNERS = "straight line", ("rrtconnect", "rrt")
LINE_ROW = Row(LINE, LINE, runner="benchmarks.planners.calibration:straight_line")


def straight_line(job: Job) -> Run:
    """Return whether the straight line is a solution, at a quarter of the velocity limits where obstacles move."""
    problem, names = problems.load(job.problem), robot().joint_names
    line = np.stack([problem.start_state(names), problem.goal_states(names)[0]])
    return {
        "solved": bool(check_timed_path(robot(), problem, line, constant_velocity_times(robot(), line, VELOCITY_SCALE)))
    }


def among_moving(job: Job) -> Run:
    """Return the columns of a run of a planner whose path is followed among the moving obstacles."""
    planning, experiment, result = runs.planned(replace(job, runner=""))
    found = runs.columns(planning, experiment, result)
    if result.path is None or not found["solved"]:
        return found
    problem = problems.load(job.problem)
    times = constant_velocity_times(robot(), result.path.states, VELOCITY_SCALE)
    check = check_timed_path(robot(), problem, result.path.states, times)
    return {**found, "solved": bool(check), "reason": check.reason}


def levels_of(wanted: Sequence[str]) -> list[str]:
    """Return all levels, or those that are wanted: SUITE or SUITE/LEVEL.

    Raises:
        SystemExit: No such suite or level.
    """
    every = [f"{suite}/{level}" for suite, levels in problems.suites().items() for level in levels]
    for name in wanted:
        if name not in every and name not in problems.suites():
            raise SystemExit(f"unknown suite or level {name!r}; known: {', '.join(every)}")
    return [level for level in every if not wanted or level in wanted or level.split("/")[0] in wanted]


def summary(some: Sequence[Run]) -> dict[str, Any]:
    """Return success at the time limits, and percentiles of times [s] and lengths [rad]; failures have infinite times.

    ``found_s`` is the time to the first path, ``simplified_s`` that to the end.
    """
    found = Statistics("", "", some)
    lengths = [run["length"] for run in found.solved]
    return {
        "n": len(some),
        "goal_blocked": sum(run["status"] == "INVALID_GOAL" for run in some),
        "success": {str(limit): found.share_within(limit) for limit in LIMITS},
        "found_s": [record.reached(found.times("first"), p) for p in (50, 95)],
        "simplified_s": [record.reached(found.times("total"), p) for p in (50, 95)],
        "length_rad": record.percentiles(lengths, 50, 95) if lengths else [None, None],
    }


def _cell(value: float | None) -> str:
    if value is None:
        return f"> {TIMEOUT:g}"
    return f"{value:.3f}" if value < 1.0 else f"{value:.1f}"


def table(levels: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown table of the statistics of levels."""
    head = ["suite/level", "line", "planner", "N", *(f"solved in {limit:g} s" for limit in LIMITS)]
    head += ["found s p50", "p95", "simplified s p50", "p95", "length rad p50", "p95"]
    rows = [head, ["---", "---:", "---", *["---:"] * (len(head) - 3)]]
    for level in levels:
        name = [level["level"], f"{level['line']:.2f}"]
        for planner, s in level["planners"].items():
            rows.append(
                [*name, planner, s["n"], *(f"{v:.2f}" for v in s["success"].values()), *map(_cell, s["found_s"]),
                 *map(_cell, s["simplified_s"]), *("-" if v is None else f"{v:.1f}" for v in s["length_rad"])]
            )  # fmt: skip
            name = ["", ""]
        if not level["planners"]:
            rows.append([*name, *["-"] * (len(head) - 2)])
    return "\n".join(record.row(row) for row in rows)


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=50, of="problems for rrtconnect", jobs=2)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("--rrt", type=whole_number, default=20, help="problems for rrt (default: %(default)s)")
    parser.add_argument("--lines", type=one_or_more, default=100, help="problems for the line (default: %(default)s)")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    levels = levels_of(args.levels)
    most = dict(zip(PLANNERS, (args.n, args.rrt), strict=True))
    rows = [
        Row(name, name, runs=k, runner="benchmarks.planners.calibration:among_moving") for name, k in most.items() if k
    ]
    moving = [level for level in levels if "/moving-" in level]
    if not args.report:
        workers = Workers(args.jobs)
        for some, wanted, count in ((levels, [LINE_ROW], args.lines), (moving, rows, max(args.n, args.rrt))):
            if some:
                bench(
                    some, wanted, args.store, runs=count, timeout=TIMEOUT, workers=workers, provenance=record.session()
                )
    results = Results.load(args.store)
    made = [run for run in results.runs if run["experiment"] in levels and run["status"] != runs.NO_PROBLEM]
    by = {(level, label): list[Run]() for level in levels for label in (LINE, *PLANNERS)}
    for run in made:
        by[run["experiment"], run["label"]].append(run)
    found = [
        {"level": level, "line": float(np.mean([run["solved"] for run in by[level, LINE]])),
         "line_n": len(by[level, LINE]),
         "planners": {name: summary(by[level, name]) for name in PLANNERS if by[level, name]}}
        for level in levels if by[level, LINE]
    ]  # fmt: skip
    record.write(
        "calibration", {"levels": found}, table(found), split="test", timeout=TIMEOUT,
        seeds="number of the problem modulo 1000", **record.made_with(replace(results, runs=made)),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
