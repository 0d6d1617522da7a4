"""Planners head to head on all static levels of the test split, through ``apex_ompl.evaluation``.

Rows: apex; apex without trees after its proposals; the straight line and its repair, which ends by itself; rounds of
eight random perturbations instead of proposals, with the same repair, for 2 s; rrtconnect+polish; rrtconnect as OMPL
has it and tuned; and the baselines of the paper, with their defaults, which are tuned: drrt, gpmp, gpmp2, damon, and
the policies il and il-paper, which are rolled out once. On the hard and large levels alone: apex with guidance; and, on
20 problems of each, the paper's algorithm alone (``apex-paper``), and tuned, 5 s, rrt, lbkpiece1 and planners that use
their whole time limit.
Labels of tuned rows name the parameters that benchmarks/planners/tune.py chose; those without any do best with OMPL's
defaults. apex and rrtconnect+polish have theirs as defaults.
Each run is stored in benchmarks/runs/head_to_head when it ends, with OMPL's logs and the database for Planner Arena;
the command resumes where it was stopped. The paths are stored there too, for recheck.py.

scripts/reproduce.py keeps runs of its own, in benchmarks/runs/paper_figures.

Usage: python -m benchmarks.planners.head_to_head [SUITE[/LEVEL] ...] [-n 30] [--slow 20] [--jobs 1]
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from apex_ompl.evaluation import Row, Workers, bench, report, write_database, write_logs
from apex_ompl.evaluation.rows import PAPER
from apex_ompl.evaluation.summary import SHARE_TIMES, Statistics, Table, statistics, tables, warnings
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = (
    "@benchmark", "apex_ompl/baselines", "benchmarks/baselines", "benchmarks/lib/controls.py",
    "benchmarks/lib/control_planners.py",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs" / "head_to_head"
TIMEOUT = 10.0  # [s]
SLOW = 20  # problems of a level for rows that take long
TIMES = (("first", 50), ("first", 95), ("first", 99), ("total", 50))
GROUPS = {
    "free, easy, small": ("free", "easy", "small"),
    "medium": ("medium",),
    "hard, large": ("hard", "large"),
    "extreme": ("extreme",),
    "all": ("free", "easy", "small", "medium", "hard", "large", "extreme"),
}
HARD = ("/hard", "/large")
BASELINES = ("drrt", "gpmp", "gpmp2", "damon", "il", "il-paper")  # of the paper, or what came of them
TREELESS = {"fallback": False, "bridge": False}
ROWS = (
    Row("apex", "apex"),
    Row("apex without trees", "apex", TREELESS),
    Row("apex guided", "apex", {"guidance": True}, levels=HARD),
    Row("apex-paper", "apex", {**PAPER, "guidance": True}, runs=SLOW, levels=HARD),
    Row("straight line + repair", "apex", {**TREELESS, "first": 0, "second": 0, "third": 0, "resample": 0}, 2.0),
    Row(
        "8 perturbations + repair",
        "apex",
        {**TREELESS, "model": "none", "line": False, "first": 8, "second": 0, "third": 0, "resample": 0},
        2.0,
    ),
    Row("rrtconnect+polish", "rrtconnect+polish"),
    Row("rrtconnect", "rrtconnect"),
    Row.of("rrtconnect", TUNED["rrtconnect"]),
    *(Row(name, name) for name in BASELINES),
    *(
        Row.of(name, TUNED[name], timeout=5.0, runs=SLOW, levels=HARD)
        for name in ("rrt", "lbkpiece1", "aorrtc", "informedrrtstar", "bitstar")
    ),
)


def together(
    found: Sequence[Statistics], wanted: Sequence[Row] = ROWS, groups: Mapping[str, Sequence[str]] = GROUPS
) -> Table:
    """Return the statistics of each row over levels together, with its lengths over those of apex.

    Args:
        found: Statistics of the rows on each level.
        wanted: The rows.
        groups: Name of a group -> its levels, as ``shelf/hard``, or ``hard`` for those of all suites.
    """
    rows = []
    for group, levels in groups.items():
        mine = [f for f in found if f.experiment in levels or f.experiment.split("/")[1] in levels]
        best = {run["problem"]: run["length"] for f in mine if f.label == "apex" for run in f.solved}
        for row in wanted:
            parts = [f for f in mine if f.label == row.label]
            if not parts or (row.levels and group == "all"):
                continue
            f = Statistics(group, row.label, [run for part in parts for run in part.runs])
            low, high = share_interval(len(f.solved), len(f.runs))
            both = [math.log(run["length"] / best[run["problem"]]) for run in f.solved if best.get(run["problem"])]
            shares = [f"{f.share_within(t):.3f}" if t <= f.limit else "-" for t in SHARE_TIMES]
            times = [f.percentile(which, p) for which, p in TIMES]
            rows.append([
                group, row.label, str(len(f.runs)),
                f"{len(f.solved) / len(f.runs):.3f} ({low:.3f} to {high:.3f})", *shares,
                *(f"{1e3 * t:.0f}" if math.isfinite(t) else "-" for t in times),
                f"{math.exp(np.mean(both)):.2f} ({len(both)})" if both else "-",
            ])  # fmt: skip
    within = [f"in {t:g} s" for t in SHARE_TIMES]
    head = ["levels", "planner", "N", "solved (95 %, Wilson)", *within, "first path p50 ms", "p95", "p99", "end p50 ms"]
    head += ["length / apex's (problems that both solved)"]
    return Table("Levels together", head, rows)


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=30, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument(
        "--slow", type=one_or_more, default=SLOW, help="of them for rows that take long (default: %(default)s)"
    )
    args = parser.parse_args()
    workers = Workers(args.jobs, modules=("control_planners",))
    rows = [row if row.runs is None else replace(row, runs=args.slow) for row in ROWS]
    levels, seeds = record.static_levels(args.levels), {row.label: min(args.n, row.runs or args.n) for row in rows}
    results = bench(
        levels, rows, FOLDER, runs=args.n, timeout=TIMEOUT, workers=workers, keep=True, provenance=record.session()
    )
    results = replace(results, runs=[run for run in results.runs if run["seed"] < seeds.get(run["label"], 0)])
    write_database(results, write_logs(results))
    report(FOLDER, FOLDER)
    found = [table for table in (together(statistics(results)), *tables(results)) if table.rows]
    text = "\n\n".join([*warnings(results), *(table.markdown() for table in found)])
    data = {"tables": [{"title": t.title, "head": list(t.head), "rows": [list(r) for r in t.rows]} for t in found]}
    about = {"timeout": f"{TIMEOUT:g} s but for rows with their own", "seeds": "0 to N - 1"}
    record.write("head_to_head", data, text, split="test", **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
