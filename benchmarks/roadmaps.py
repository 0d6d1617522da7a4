"""Dynamic RRT and DAMON on validation problems: shares solved, and with --tune how their parameters were chosen.

Shares are of paths that passed the full check, in 10 s without the straight line, which plans try before the planner.

--tune: six candidates of each planner, 5 s a run, on the first problems of each level; the one that solves
most is chosen, of equal ones the first. Models of other manifolds are made in benchmarks/runs/roadmaps. The table is of
other problems. Runs are stored when they end, and the command resumes where it was stopped.

Usage: python benchmarks/roadmaps.py [--tune] [-n 8] [--jobs 1]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from typing import Any

import record

from apex_ompl.benchmark import Results, Row, Workers, bench
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more

DEPENDS = (
    "@planning", "apex_ompl/benchmark", "apex_ompl/roadmaps", "benchmarks/baselines", "scripts/train_damon.py",
)  # fmt: skip
FOLDER = record.ROOT / "benchmarks" / "runs" / "roadmaps"
LEVELS = ("vertical/free", "vertical/small", "horizontal/free", "horizontal/small", "shelf/easy")
TIMEOUT, TUNING_TIMEOUT = 10.0, 5.0  # [s]
TUNED_ON = 100  # problems of a level, counted from the first, that the table keeps away from
MODELS = {"beta-1e-4": ["--beta", "1e-4"], "nodes-5000": ["--nodes", "5000"]}
"""Manifolds of two dimensions that are tried besides the one that is kept, and how they are made."""

ROWS = [
    *(Row.of("damon", {"model": f"damon-{dim}", "nodes": kind}) for kind in ("decoded", "stored") for dim in (2, 4, 8)),
    Row.of("drrt", runs=4), Row.of("rrt", runs=4),
]  # fmt: skip


def candidates() -> dict[str, list[Row]]:
    """Return the candidates of each planner, the default first."""
    trees = [(0.3, 0.1), (0.7, 0.1), (1.4, 0.1), (0.7, 0.3), (1.4, 0.3), (1.4, 0.5)]
    others = [f"../runs/roadmaps/{name}/damon-2" for name in MODELS]
    connections = [Row.of("damon", {"model": "damon-2", "connections": count}) for count in (100, 12, 400, 1000)]
    return {
        "damon": [*connections, *(Row.of("damon", {"model": name, "connections": 100}) for name in others)],
        "drrt": [Row.of("drrt", {"range": step, "goal_bias": bias}) for step, bias in trees],
    }


def run(rows: list[Row], name: str, args: argparse.Namespace, *, first: int, timeout: float) -> Results:
    """Make the runs that are missing, and return all."""
    return bench(
        LEVELS, rows, FOLDER / name, runs=args.n, timeout=timeout, seed=first, split="validation", simplify=False,
        workers=Workers(args.jobs), provenance=record.session(),
    )  # fmt: skip


def shares(results: Results, label: str) -> list[tuple[int, int]]:
    """Return the numbers of solved and of all runs of a row, on each level and on all."""
    runs = [run for run in results.runs if run["label"] == label]
    groups = [[run for run in runs if run["experiment"] == level] for level in LEVELS] + [runs]
    return [(sum(bool(run["solved"]) for run in group), len(group)) for group in groups]


def table(results: Results, rows: list[Row], chosen: set[str]) -> tuple[dict[str, Any], str]:
    """Return the values of the result, and the Markdown table."""
    lines = [record.row(["planner", *LEVELS, "all", "95 %"]), record.row(["---", *["---:"] * (len(LEVELS) + 2)])]
    values: dict[str, Any] = {}
    for row in rows:
        found = shares(results, row.label)
        low, high = share_interval(*found[-1])
        values[row.label] = {"solved": dict(zip([*LEVELS, "all"], found, strict=True)), "interval": [low, high]}
        name = f"**{row.label}**" if row.label in chosen else row.label
        lines.append(record.row([name, *(f"{a}/{n}" for a, n in found), f"{low:.2f}-{high:.2f}"]))
    return values, "\n".join(lines)


def tune(args: argparse.Namespace) -> None:
    """Make the models that are missing, run the candidates, and write how they did."""
    for name, options in MODELS.items():
        command = [sys.executable, "scripts/train_damon.py", "--dims", "2", "--out", FOLDER / name, *options]
        subprocess.run(command, check=True, cwd=record.ROOT)
    data, tables = dict[str, Any](), list[str]()
    for planner, rows in candidates().items():
        results = run(rows, "tune", args, first=0, timeout=TUNING_TIMEOUT)
        best = max(rows, key=lambda row: shares(results, row.label)[-1][0])
        values, text = table(results, rows, {best.label})
        data[planner] = {"candidates": values, "chosen": dict(best.params)}
        tables.append(text)
    about = {"split": "validation", "limit": f"{TUNING_TIMEOUT:g} s", "problems_a_level": args.n}
    record.write("roadmaps_tune", data, "\n\n".join(tables), **about, **record.made_with(results))


def main() -> None:
    """Run what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tune", action="store_true", help="compare candidates")
    parser.add_argument("-n", type=one_or_more, default=8, help="problems of a level (default: %(default)s)")
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: one)")
    args = parser.parse_args()
    if args.tune:
        tune(args)
        return
    results = run(ROWS, "table", args, first=TUNED_ON, timeout=TIMEOUT)
    values, text = table(results, ROWS, set())
    about = {"split": "validation", "limit": f"{TIMEOUT:g} s", "problems_a_level": args.n}
    about["first_problem"] = f"800000 + {TUNED_ON}"
    record.write("roadmaps", {"rows": values}, text, **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
