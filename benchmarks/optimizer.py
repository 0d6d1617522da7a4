"""The optimiser against rrtconnect: success, time and length on the frozen validation problems.

The optimiser starts from the straight line, and from 8 and 32 bumps (the line among them); what it finds is shortened.
Beside it rrtconnect with OMPL's simplification, rrtconnect+polish, and on hard levels aorrtc with 30 s. Every path is
judged by the same full check. Times leave out the setup of the problem. Runs are kept in a store as they end (JSON
lines), so that the command goes on where it was stopped.

Usage: python benchmarks/optimizer.py [-n 10] [--hard 20] [--jobs 2] [--store FILE] [--report] [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import record
from store import RunStore

from apex_ompl import plan, problems
from apex_ompl.ompl_adapter.setup import assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.reach import robot
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.trajopt.path import path_length
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more, whole_number

STORE = record.RESULTS.parent / "runs" / "optimizer.jsonl"
STARTS = {"line": 1, "8 bumps": 8, "32 bumps": 32}
PLANNERS = {"rrtconnect": 10.0, "rrtconnect+polish": 10.0, "aorrtc": 30.0}  # and their time limits [s]
METHODS = (*STARTS, *PLANNERS)
ON_HARD_ALONE = ("aorrtc",)


def run(job: tuple[str, str]) -> dict[str, Any]:
    """Return one run of a method on a problem."""
    name, method = job
    seed = int(name.rsplit("/", 1)[1]) % 1000
    if method in STARTS:
        return {"problem": name, "method": method, **_optimised(name, STARTS[method], seed)}
    result = plan(problems.load(name), method, timeout=PLANNERS[method], seed=seed)
    took = sum(result.times.get(k, 0.0) for k in ("line", "solve", "simplify", "verify", "repair"))
    length = result.length if result else None
    return {"problem": name, "method": method, "solved": bool(result), "total_s": took, "length": length}


def _optimised(name: str, count: int, seed: int) -> dict[str, Any]:
    ready, optimizer = assemble(problems.load(name), robot()), Optimizer()
    kernel, start, goal = ready.checker.kernel, ready.start, ready.goals[0]

    def is_valid(path: np.ndarray) -> bool:
        return bool(full_check(ready.checker, path, start, [goal]))

    begin = time.perf_counter()
    starts = optimizer.starts(start, goal, count, np.random.default_rng(seed))
    found = first_valid(optimizer, kernel, starts, is_valid)
    found_s = time.perf_counter() - begin
    best = None if found is None else optimizer.shorten(kernel, found, is_valid)
    best = found if best is None else best
    took = time.perf_counter() - begin
    length = None if best is None else path_length(optimizer.spline.path(best))
    return {"solved": best is not None, "found_s": found_s, "total_s": took, "length": length}


def warm_up() -> None:
    """Load the kernel and the robot, so that no run pays for it."""
    run(("wall/easy/800000", "line"))
    plan("wall/easy/800000", "rrtconnect+polish", timeout=5.0)


def figures(runs: dict[tuple[Any, ...], dict[str, Any]], level: str) -> dict[str, Any]:
    """Return success, time and length of every method on a level, and lengths on what all of two solve."""
    mine = {key: r for key, r in runs.items() if key[0].rsplit("/", 1)[0] == level}
    found: dict[str, Any] = {}
    for method in METHODS:
        some = [r for (_, m), r in mine.items() if m == method]
        if not some:
            continue
        took = np.sort([r["total_s"] if r["solved"] else math.inf for r in some])
        middle = float(took[(len(took) - 1) // 2])
        polished = {n: r for (n, m), r in mine.items() if m == "rrtconnect+polish" and r["solved"]}
        pairs = [
            (r["length"], polished[r["problem"]]["length"]) for r in some if r["solved"] and r["problem"] in polished
        ]
        found[method] = {
            "n": len(some), "success": float(np.mean([r["solved"] for r in some])),
            "total_s_p50": middle if math.isfinite(middle) else None,
            "solved_s_p50": float(np.median(took[np.isfinite(took)])) if np.isfinite(took).any() else None,
            "length_p50": float(np.median([r["length"] for r in some if r["solved"]] or [math.nan])),
            "polished_over_length": float(np.exp(np.mean([math.log(b / a) for a, b in pairs]))) if pairs else None,
            "pairs": len(pairs),
        }  # fmt: skip
    return found


def table(levels: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown table."""
    head = ["suite/level", "method", "N", "solved", "time s p50", "time s p50 when solved", "length rad p50"]
    head += ["rrtconnect+polish / this length", "on"]
    rows = [head, ["---", "---", *["---:"] * (len(head) - 2)]]
    for level in levels:
        for k, (method, f) in enumerate(level["methods"].items()):
            times = ["> limit" if f["total_s_p50"] is None else f"{f['total_s_p50']:.3f}"]
            times += ["-" if f["solved_s_p50"] is None else f"{f['solved_s_p50']:.3f}"]
            ratio = "-" if f["polished_over_length"] is None else f"{f['polished_over_length']:.2f}"
            length = "-" if math.isnan(f["length_p50"]) else f"{f['length_p50']:.1f}"
            name = level["level"] if k == 0 else ""
            rows.append([name, method, f["n"], f"{f['success']:.2f}", *times, length, ratio, f["pairs"]])
    return "\n".join(record.row(row) for row in rows)


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=one_or_more, default=10, help="of a level, at most 30 (default: %(default)s)")
    parser.add_argument("--hard", type=whole_number, default=20, help="of a hard level (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of what the store holds")
    args = parser.parse_args()
    chosen = record.static_levels(args.levels)
    store = RunStore(args.store, ("problem", "method"))
    done, todo = store.read(), []
    for level in chosen:
        hard = level.endswith("/hard")
        names = problems.frozen_names(*level.split("/"), "validation")[: args.hard if hard else args.n]
        methods = [m for m in METHODS if hard or m not in ON_HARD_ALONE]
        todo += [(name, m) for m in methods for name in names if (name, m) not in done]
    todo.sort(key=lambda job: (job[1] in ON_HARD_ALONE, job[0].rsplit("/", 1)[1]))  # all levels in turn
    store.complete(run, [] if args.report else todo, args.jobs, warm_up)
    runs = store.read()
    levels = [{"level": level, "methods": figures(runs, level)} for level in record.static_levels([])]
    levels = [level for level in levels if level["methods"]]
    record.write(
        "optimizer", {"levels": levels}, table(levels), split="validation", time_limits=PLANNERS,
        seeds="number of the problem modulo 1000", **record.made_with(runs.values()),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
