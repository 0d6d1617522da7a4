"""Planners head to head on all static levels of the test split, through ``apex_ompl.benchmark``.

Rows: apex; without the trees behind its proposals; with guidance; the paper's algorithm alone (``apex-paper``, on 20
problems of a level); the straight line, and eight random bumps in the place of proposals, with the same repair, for
2 s; rrtconnect+polish; rrtconnect; rrt on 20 problems of a level; and planners that use all the time they get, 5 s, on
20 problems of the hard and large levels.
Runs are kept in benchmarks/runs/head_to_head as they end, with OMPL's logs and the database for Planner Arena; the
command goes on where it was stopped.

scripts/reproduce.py takes its runs from there, and adds some.

Usage: python benchmarks/head_to_head.py [SUITE[/LEVEL] ...] [-n 50] [--jobs 1]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import record

from apex_ompl.benchmark import Row, Workers, bench, report, write_database, write_logs
from apex_ompl.benchmark.rows import PAPER
from apex_ompl.benchmark.summary import tables, warnings

TIMEOUT = 10.0  # [s]
TREELESS = {"fallback": False, "bridge": False}
ROWS = (
    Row("apex", "apex"),
    Row("apex without trees", "apex", TREELESS),
    Row("apex guided", "apex", {"guidance": True}),
    Row("apex-paper", "apex", {**PAPER, "guidance": True}, runs=20),
    Row("straight line + repair", "apex", {**TREELESS, "first": 0, "second": 0, "third": 0, "resample": 0}, 2.0),
    Row(
        "8 bumps + repair",
        "bumps",
        {**TREELESS, "line": False, "first": 8, "second": 0, "third": 0, "resample": 0},
        2.0,
    ),
    Row("rrtconnect+polish", "rrtconnect+polish"),
    Row("rrtconnect", "rrtconnect"),
    Row("rrt", "rrt", runs=20),
    *(
        Row(name, name, timeout=5.0, runs=20, levels=("/hard", "/large"))
        for name in ("aorrtc", "informedrrtstar", "bitstar")
    ),
)


def main() -> None:
    """Run what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=int, default=50, help="problems of a level (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time (default: one, as they are timed)")
    args = parser.parse_args()
    folder = Path(__file__).parent / "runs" / "head_to_head"
    workers = Workers(args.jobs, modules=("controls",))
    levels, labels = record.static_levels(args.levels), {row.label for row in ROWS}
    results = bench(levels, ROWS, folder, runs=args.n, timeout=TIMEOUT, workers=workers)
    results = replace(results, runs=[run for run in results.runs if run["label"] in labels])
    write_database(results, write_logs(results))
    report(folder, folder)
    found = [table for table in tables(results) if table.rows]
    text = "\n\n".join([*warnings(results), *(table.markdown() for table in found)])
    figures = {"tables": [{"title": t.title, "head": list(t.head), "rows": [list(r) for r in t.rows]} for t in found]}
    about = {"jobs": args.jobs, "timeout": f"{TIMEOUT:g} s but for rows that say otherwise", "seeds": "0 to N - 1"}
    record.write("head_to_head", figures, text, split="test", **about)


if __name__ == "__main__":
    main()
