"""This checkout beside another one, paired: the same problems and seeds, one after the other in two processes.

Each process keeps its planner, has planned once before, and is given the problems in turn, so that what else the
machine does falls on both. Times are of whole calls, of ``solve``, of the first path and of its stages; lengths are
compared where both solve a problem. Levels are the hard ones of the suites, or those that are asked for, as
``unseen/truss``, of a suite of scenes that no training data are of, which is for validation alone.

Usage: python -m benchmarks.planners.before_after FOLDER [-n 8] [--seeds 2] [--split validation] [--levels LEVEL ...]
FOLDER is another checkout, ``git worktree add FOLDER COMMIT`` makes one.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, Self

import numpy as np
from tqdm import tqdm

from apex_ompl import problems
from apex_ompl.result import FIRST, INSIDE
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.lib.checkouts import add_checkout, commit, environment
from benchmarks.planners.apex_profile import HARD

DEPENDS = (
    "@planning", "apex_ompl/timing", "apex_ompl/planning", "benchmarks/planners/apex_profile.py",
    "benchmarks/lib/checkouts.py",
)  # fmt: skip
TIMEOUT = 10.0  # [s]
STAGES = ("call", "solve", "first path", "propose", "repair", "polish", "verify", "timing")
WORKER = """
import json, sys, time
from apex_ompl import MotionPlanner, load_problem
from ompl import util
util.noOutputHandler()
with MotionPlanner() as planner:
    planner.plan_problem(load_problem("wall/easy/800000"))
    print("ready", flush=True)
    for line in sys.stdin:
        name, seed, timeout = json.loads(line)
        problem = load_problem(name)
        began = time.perf_counter()
        result = planner.plan_problem(problem, timeout=timeout, seed=seed)
        took, times = time.perf_counter() - began, dict(result.times)
        print(json.dumps([bool(result), result.length, took, times]), flush=True)
"""


class Worker:
    """A process that plans with the code of a checkout."""

    def __init__(self, folder: Path) -> None:
        """Start it, and wait until it has planned once."""
        self.process = subprocess.Popen(
            [sys.executable, "-c", WORKER], cwd=folder, env=environment(folder), stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        self._answer()

    def __enter__(self) -> Self:
        """Use the process in a block."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        self.process.kill()
        self.process.wait()

    def plan(self, name: str, seed: int) -> dict[str, float]:
        """Plan a problem, and return the length of its path [rad] and times [s]."""
        assert self.process.stdin is not None
        print(json.dumps([name, seed, TIMEOUT]), file=self.process.stdin, flush=True)
        solved, length, call, times = json.loads(self._answer())
        found = {"solved": float(solved), "length": length, "call": call, "solve": times.get("solve", 0.0)}
        found["first path"] = times.get("line", 0.0) + times.get(FIRST, times.get("solve", 0.0))
        inner = {name: times.get(INSIDE + name, times.get(name, 0.0)) for name in STAGES[3:]}
        return found | inner | ({} if solved else {"first path": np.inf, "solve": np.inf, "call": np.inf})

    def _answer(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit("a process that plans has ended: is the folder a checkout of this project?")
        return line


def table(before: list[dict[str, float]], after: list[dict[str, float]]) -> list[list[Any]]:
    """Return the rows of the table of some problems."""
    rows: list[list[Any]] = []
    for name in STAGES:
        values = [record.reached([x[name] for x in some], p) for p in (50, 95) for some in (before, after)]
        cells = ["-" if value is None else f"{1e3 * value:.1f}" for value in values]
        rows.append([f"{name} ms", *cells])
    return rows


def main() -> None:
    """Measure, and write the results."""
    parser = record.parser(__doc__, n=8)
    add_checkout(parser)
    parser.add_argument("--seeds", type=one_or_more, default=2, help="seeds of each (default: %(default)s)")
    parser.add_argument("--split", default="validation", choices=("validation", "test"))
    parser.add_argument("--levels", nargs="+", default=list(HARD), metavar="LEVEL", help="(default: the hard ones)")
    args = parser.parse_args()
    names = [n for level in args.levels for n in problems.frozen_names(*level.split("/"), args.split)[: args.n]]
    jobs = [(name, seed) for name in names for seed in range(args.seeds)]
    found: tuple[list[dict[str, float]], list[dict[str, float]]] = ([], [])
    with Worker(args.folder) as before, Worker(record.ROOT) as after:
        workers = (before, after)
        for k, (name, seed) in enumerate(tqdm(jobs, unit="problem")):
            for side in (0, 1) if k % 2 == 0 else (1, 0):
                found[side].append(workers[side].plan(name, seed))
    both = [(a, b) for a, b in zip(*found, strict=True) if a["solved"] and b["solved"]]
    ratios = np.array([b["length"] / a["length"] for a, b in both])
    solved = [f"{np.mean([x['solved'] for x in some]):.3f}" for some in found]
    head = ["", "before p50", "after p50", "before p95", "after p95"]
    rows = [head, ["---", *["---:"] * 4], *table(*found), ["solved (of all)", *solved, "", ""]]
    rows.append(["length after / before, mean and p50", f"{ratios.mean():.4f}", f"{np.median(ratios):.4f}", "", ""])
    text = "\n".join(record.row(row) for row in rows)
    record.write(
        "before_after", {"jobs": jobs, "before": found[0], "after": found[1]}, text, split=args.split, n=len(jobs),
        seeds=args.seeds, before=commit(args.folder),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
