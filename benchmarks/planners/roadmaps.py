"""Dynamic RRT and DAMON, with manifolds of 2, 4 and 8 dimensions, on validation problems: shares solved.

Shares are of paths that passed the full check, in 10 s without the straight line, which plans try before the planner,
on other problems than those that they are tuned on (benchmarks/planners/tune.py). Runs are stored when they end, and
the command resumes where it was stopped.

Usage: python -m benchmarks.planners.roadmaps [-n 8] [--jobs 1]
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.runs import NO_PROBLEM
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record
from benchmarks.planners.tune import TUNED_ON

DEPENDS = (
    "@planning", "apex_ompl/evaluation", "apex_ompl/baselines", "benchmarks/baselines", "benchmarks/planners/tune.py",
    "scripts/train_damon.py",
)  # fmt: skip
FOLDER = record.ROOT / "benchmarks" / "runs" / "roadmaps"
LEVELS = ("vertical/free", "vertical/small", "horizontal/free", "horizontal/small", "shelf/easy")
TIMEOUT = 10.0  # [s]

ROWS = [
    *(Row.of("damon", {"model": f"damon-{dim}", "nodes": kind}) for kind in ("decoded", "stored") for dim in (2, 4, 8)),
    Row.of("drrt", runs=4), Row.of("rrt", runs=4),
]  # fmt: skip


def shares(results: Results, label: str) -> list[tuple[int, int]]:
    """Return the numbers of solved and of all runs of a row, on each level and on all."""
    runs = [run for run in results.runs if run["label"] == label]
    groups = [[run for run in runs if run["experiment"] == level] for level in LEVELS] + [runs]
    return [(sum(bool(run["solved"]) for run in group), len(group)) for group in groups]


def table(results: Results) -> tuple[dict[str, Any], str]:
    """Return the values of the result, and the Markdown table."""
    lines = [record.row(["planner", *LEVELS, "all", "95 %"]), record.row(["---", *["---:"] * (len(LEVELS) + 2)])]
    values: dict[str, Any] = {}
    for row in ROWS:
        found = shares(results, row.label)
        low, high = share_interval(*found[-1])
        values[row.label] = {"solved": dict(zip([*LEVELS, "all"], found, strict=True)), "interval": [low, high]}
        lines.append(record.row([row.label, *(f"{a}/{n}" for a, n in found), f"{low:.2f}-{high:.2f}"]))
    return values, "\n".join(lines)


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=8, jobs=1)
    args = parser.parse_args()
    results = bench(
        LEVELS, ROWS, FOLDER, runs=args.n, timeout=TIMEOUT, first=TUNED_ON, split="validation", simplify=False,
        workers=Workers(args.jobs), provenance=record.session(),
    )  # fmt: skip
    mine = [run for run in results.runs if run["status"] != NO_PROBLEM and 0 <= run["seed"] - TUNED_ON < args.n]
    values, text = table(replace(results, runs=mine))
    about = {"split": "validation", "limit": f"{TIMEOUT:g} s", "problems_a_level": args.n}
    about["first_problem"] = f"{800_000 + TUNED_ON}"
    record.write("roadmaps", {"rows": values}, text, **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
