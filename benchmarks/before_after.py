"""rrtconnect with the checker in two stages and with the meshes alone, on every ready-made problem and on Baxter.

Both run in turn with the same seeds, so the searches are the same as far as the clock lets them. Times are those of
the search itself, and of everything after the problem was set up (straight lines, search, simplification, proof,
repair), in milliseconds.

Usage: python benchmarks/before_after.py [--planner rrtconnect] [--seeds 20] [--timeout 10]
"""

from __future__ import annotations

import argparse
from functools import partial
from unittest import mock

import numpy as np
import record
from shipped_problems import BAXTER

from apex_ompl import PlanResult, plan, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.ompl_adapter import setup
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

WORK = ("line", "solve", "simplify", "verify", "repair")


def times(result: PlanResult) -> dict[str, float]:
    """Return milliseconds of search, and of all work on a set-up problem."""
    work = sum(result.times.get(stage, 0.0) for stage in WORK)
    return {"search": result.times.get("solve", 0.0) * 1e3, "all": work * 1e3}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--planner", default="rrtconnect")
    parser.add_argument("--seeds", type=one_or_more, default=20)
    parser.add_argument("--timeout", type=float, default=10.0)
    args = parser.parse_args()
    rows, figures = [], []
    pooled: dict[tuple[str, bool], list[float]] = {}
    for name in [*problems.names(), BAXTER]:
        plan(name, args.planner, timeout=args.timeout)  # compiled code is loaded
        runs: dict[bool, list[PlanResult]] = {True: [], False: []}
        for seed in range(args.seeds):
            for proofs in (True, False):
                with mock.patch.object(setup, "CollisionChecker", partial(CollisionChecker, proofs=proofs)):
                    runs[proofs].append(plan(name, args.planner, timeout=args.timeout, seed=seed))
        row: list[object] = [
            runs[True][0].problem.name,
            *(f"{sum(map(bool, runs[p]))}/{args.seeds}" for p in (True, False)),
        ]
        same = sum(
            a.path is not None and b.path is not None and np.array_equal(a.path, b.path)
            for a, b in zip(runs[True], runs[False], strict=True)
        )
        row.append(same)
        figure: dict[str, object] = {"problem": row[0], "same_path": same}
        for what in ("search", "all"):
            values = {p: [times(r)[what] for r in runs[p] if r and (what == "all" or "solve" in r.times)] for p in runs}
            for p in runs:
                pooled.setdefault((what, p), []).extend(values[p])
            after, before = (np.percentile(values[p], [50, 95]) for p in (True, False))
            row += [f"{v:.1f}" for v in (*before, *after)] + [f"{v:.1f}" for v in before / after]
            figure[what] = {"meshes_ms": values[False], "two_stages_ms": values[True]}
        rows.append(row)
        figures.append(figure)
    row = ["all of them", "", "", ""]
    for what in ("search", "all"):
        after, before = (np.percentile(pooled[what, p], [50, 95]) for p in (True, False))
        row += [f"{v:.1f}" for v in (*before, *after)] + [f"{v:.1f}" for v in before / after]
    rows.append(row)
    head = ["problem", "exact, two stages", "meshes", "same path"]
    for what in ("search", "all work"):
        head += [f"{what}, meshes ms p50", "p95", "two stages p50", "p95", "ratio p50", "p95"]
    table = "\n".join(record.row(r) for r in [head, ["---"] + ["---:"] * (len(head) - 1), *rows])
    record.write("before_after", {"problems": figures}, table, seeds=f"0-{args.seeds - 1}", N=args.seeds,
                 planner=args.planner, timeout=args.timeout)  # fmt: skip


if __name__ == "__main__":
    run_script(main)
