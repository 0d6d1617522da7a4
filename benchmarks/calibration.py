"""How hard the suites are: what the straight line, rrtconnect and rrt make of the first test problems.

Runs are kept in a store as they end (JSON lines), so that the command goes on where it was stopped; the results are
made of all runs in the store. On levels with moving obstacles planners see the scene of time 0, and what they find is
followed at a quarter of the velocity limits among the moving obstacles: a run counts when nothing is hit. Of those
levels 20 test problems are frozen; more are drawn, and may have no solution. A cube may be where the goal is at time
0; such runs fail, and are counted as ``goal_blocked``.

Usage: python benchmarks/calibration.py [-n 50] [--rrt 20] [--jobs 2] [--store FILE] [--report] [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import record
from store import RunStore

from apex_ompl import plan, problems
from apex_ompl.live.moving import even_times, timed_check
from apex_ompl.problems.alignment import PACE
from apex_ompl.problems.reach import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number

FIRST = 900_000  # seed of the first test problem
TIMEOUT, LIMITS = 10.0, (0.5, 2.0, 10.0)  # [s]
STORE = record.RESULTS.parent / "runs" / "calibration.jsonl"
FINDING = ("line", "solve", "verify", "repair")  # stages that count as finding a path
LINE = "straight line"


def run(job: tuple[str, str]) -> dict[str, Any]:
    """Return one run of a planner, or of the straight line alone, on a problem."""
    name, planner = job
    problem = problems.load(name)
    if planner == LINE:
        return {"problem": name, "planner": planner, "solved": _line(name)}
    result = plan(problem, planner, timeout=TIMEOUT, seed=int(name.rsplit("/", 1)[1]) % 1000, snapshot=True)
    solved, reason = bool(result), result.reason
    if solved and problem.moving:
        check = timed_check(robot(), problem, result.path, even_times(robot(), result.path, PACE))
        solved, reason = bool(check), check.reason
    return {
        "problem": name, "planner": planner, "solved": solved, "by": result.solved_by, "status": str(result.status),
        "reason": reason, "found_s": sum(result.times.get(k, 0.0) for k in FINDING),
        "simplify_s": result.times.get("simplify", 0.0), "length": result.length if solved else None,
    }  # fmt: skip


def _line(name: str) -> bool:
    """Whether the straight line solves a problem, at a quarter of the velocity limits where obstacles move."""
    problem, names = problems.load(name), robot().joint_names
    line = np.stack([problem.start_state(names), problem.goal_states(names)[0]])
    return bool(timed_check(robot(), problem, line, even_times(robot(), line, PACE)))


def warm_up() -> None:
    """Load the kernel and the robot, so that no run pays for it."""
    plan(problems.frozen_names("shelf", "hard")[0], timeout=0.1, simplify=False)


def summary(runs: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return success at the time limits, and percentiles of times [s] and lengths [rad]; failures count as endless."""
    runs = list(runs)
    found = np.array([r["found_s"] if r["solved"] else math.inf for r in runs])
    simplified = np.array([r["found_s"] + r["simplify_s"] if r["solved"] else math.inf for r in runs])
    lengths = [r["length"] for r in runs if r["solved"]]
    return {
        "n": len(runs),
        "goal_blocked": sum(r["status"] == "INVALID_GOAL" for r in runs),
        "success": {str(limit): float((found <= limit).mean()) for limit in LIMITS},
        "found_s": [record.reached(found, p) for p in (50, 95)],
        "simplified_s": [record.reached(simplified, p) for p in (50, 95)],
        "length_rad": record.percentiles(lengths, 50, 95) if lengths else [None, None],
    }


def _cell(value: float | None) -> str:
    if value is None:
        return f"> {TIMEOUT:g}"
    return f"{value:.3f}" if value < 1.0 else f"{value:.1f}"


def table(figures: list[dict[str, Any]]) -> str:
    """Return the Markdown table of the figures."""
    head = ["suite/level", "line", "planner", "N", *(f"solved in {limit:g} s" for limit in LIMITS)]
    head += ["found s p50", "p95", "simplified s p50", "p95", "length rad p50", "p95"]
    rows = [head, ["---", "---:", "---", *["---:"] * (len(head) - 3)]]
    for figure in figures:
        for planner, s in figure["planners"].items():
            rows.append(
                [*((figure["level"], f"{figure['line']:.2f}") if planner == "rrtconnect" else ("", "")), planner,
                 s["n"], *(f"{v:.2f}" for v in s["success"].values()), *map(_cell, s["found_s"]),
                 *map(_cell, s["simplified_s"]), *("-" if v is None else f"{v:.1f}" for v in s["length_rad"])]
            )  # fmt: skip
    return "\n".join(record.row(row) for row in rows)


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=one_or_more, default=50, help="problems for rrtconnect (default: %(default)s)")
    parser.add_argument("--rrt", type=whole_number, default=20, help="problems for rrt (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of what the store holds")
    args = parser.parse_args()
    every = [f"{suite}/{level}" for suite, levels in problems.suites().items() for level in levels]
    for name in args.levels:
        if name not in every and name not in problems.suites():
            raise SystemExit(f"unknown suite or level {name!r}; known: {', '.join(every)}")
    levels = [v for v in every if not args.levels or v in args.levels or v.split("/")[0] in args.levels]
    store = RunStore(args.store, ("problem", "planner"))
    done = store.read()
    todo: list[tuple[str, str]] = []
    for level in levels:
        frozen = len(problems.frozen_names(*level.split("/")))
        for planner, count in ((LINE, max(frozen, args.n)), ("rrtconnect", args.n), ("rrt", args.rrt)):
            names = [f"{level}/{FIRST + k}" for k in range(count)]
            todo += [(name, planner) for name in names if (name, planner) not in done]
    todo.sort(key=lambda job: (job[1] == "rrt", "moving" in job[0]))  # rrt, which takes most of the time, last
    todo = [] if args.report else todo
    store.complete(run, todo, args.jobs, warm_up)
    figures: list[dict[str, Any]] = []
    by_level: dict[str, list[dict[str, Any]]] = {}
    runs = store.read()
    for (name, _), one in runs.items():
        by_level.setdefault(name.rsplit("/", 1)[0], []).append(one)
    for level in every:
        mine = by_level.get(level, [])
        of = {p: [r for r in mine if r["planner"] == p] for p in (LINE, "rrtconnect", "rrt")}
        if of[LINE]:
            line = float(np.mean([r["solved"] for r in of[LINE]]))
            planners = {p: summary(of[p]) for p in ("rrtconnect", "rrt") if of[p]}
            figures.append({"level": level, "line": line, "line_n": len(of[LINE]), "planners": planners})
    record.write(
        "calibration", {"levels": figures}, table(figures), split="test", timeout=TIMEOUT,
        seeds="number of the problem modulo 1000", **record.made_with(runs.values()),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
