"""Success, time and length of planners on the ready-made problems and the Baxter example, seed by seed.

Usage: python benchmarks/shipped_problems.py [--planner rrtconnect] [--seeds 10] [--timeout 10]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import record

from apex_ompl import PlanResult, plan, problems
from apex_ompl.planning import STRAIGHT_LINE
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

BAXTER = Path(__file__).resolve().parent.parent / "examples" / "baxter_table.yaml"


def summary(result: PlanResult) -> dict[str, object]:
    """Return what is kept of one run."""
    keys = ("status", "reason", "seed", "solved_by", "length", "clearance", "checks", "times")
    return {key: value for key, value in result.as_dict().items() if key in keys}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--planner", action="append", default=[])
    parser.add_argument("--seeds", type=one_or_more, default=10)
    parser.add_argument("--timeout", type=float, default=10.0)
    args = parser.parse_args()
    rows, figures = [], []
    for planner in args.planner or ["rrtconnect"]:
        for name in [*problems.names(), BAXTER]:
            runs = [plan(name, planner, timeout=args.timeout, seed=seed) for seed in range(args.seeds)]
            good = [r for r in runs if r]
            first = sum(r.solved_by == planner for r in good)
            lines = sum(r.solved_by == STRAIGHT_LINE for r in good)
            times = record.percentiles([r.times["total"] for r in good], 50, 95)
            solve = record.percentiles([r.times.get("solve", 0.0) for r in good], 50, 95)
            length = record.percentiles([r.length for r in good], 50)[0]
            checks = record.percentiles([r.checks for r in good], 50)[0]
            figures.append(
                {"planner": planner, "problem": runs[0].problem.name, "solved": len(good), "runs": len(runs),
                 "passed_first_time": first, "straight_lines": lines, "total_s": times, "solve_s": solve,
                 "length_rad": length,
                 "checks": checks, "each": [summary(r) for r in runs]}
            )  # fmt: skip
            rows.append(
                [planner, runs[0].problem.name, f"{len(good)}/{len(runs)}", f"{first}/{len(good) - lines}", lines,
                 *(f"{t:.2f}" for t in (*solve, *times)), f"{length:.1f}", f"{checks:.0f}"]
            )  # fmt: skip
    head = [
        "planner",
        "problem",
        "exact",
        "passed the full check the first time",
        "by straight line",
        "solve s p50",
        "p95",
    ]
    head += ["total s p50", "p95", "length rad p50", "checks p50"]
    table = "\n".join(record.row(r) for r in [head, ["---"] * 4 + ["---:"] * 7, *rows])
    name = "shipped_problems"
    record.write(name, {"runs": figures}, table, seeds=f"0-{args.seeds - 1}", N=args.seeds, timeout=args.timeout)


if __name__ == "__main__":
    run_script(main)
