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
the command resumes where it was stopped. The paths are stored there too, for recheck.py. Afterwards, outside of the
timed solve, each stored path is made a motion in the time that its run has left, as ``plan`` does it, and the motions'
durations and computing times are kept in motions.jsonl there. ``planning + motion`` is what a user waits for: the time
until the planner ends, the computing time of the motion, and the motion's duration.

scripts/reproduce.py keeps runs of its own, in benchmarks/runs/paper_figures.

Usage: python -m benchmarks.planners.head_to_head [SUITE[/LEVEL] ...] [-n 30] [--slow 20] [--jobs 1]
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from apex_ompl.api import load_problem
from apex_ompl.evaluation import Results, Row, Workers, bench, report, write_database, write_logs
from apex_ompl.evaluation.rows import PAPER
from apex_ompl.evaluation.runs import Run
from apex_ompl.evaluation.summary import SHARE_TIMES, Statistics, Table, statistics, tables, warnings
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.planning import motions, steps
from apex_ompl.result import PlanResult
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = (
    "@benchmark", "apex_ompl/baselines", "apex_ompl/timing", "benchmarks/baselines",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs" / "head_to_head"
TIMEOUT = 10.0  # [s]
SLOW = 20  # problems of a level for rows that take long
MOTIONS = "motions.jsonl"  # in that folder: duration, computing time and key of each run's motion
WAIT, WAITS = "wait", (50, 95)  # column of runs, planning + motion [s], and its percentiles
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


def motion_of(run: Run, file: Path) -> dict[str, Any]:
    """Return the motion of a run's stored path, as ``plan`` makes it in the time that the run has left.

    Returns:
        The run's ``key``, the ``duration`` of the motion, None without one [s], the ``reason`` for that, and the time
        in which it was ``computed`` [s].

    Raises:
        ApexError: The path is not stored.
    """
    result = PlanResult.load(file)
    setup = steps.assemble(load_problem(run["problem"]), seed=run["seed"])
    motions.warm_up(setup.checker)
    query = steps.check(setup, timeout=run["timeout"])
    query.deadline.restart(run["timeout"] - run["total"])
    timed = steps.time(steps.ProvedPath(query, result.status, path=result.path))
    return {
        "key": run["key"], "duration": None if timed.trajectory is None else timed.trajectory.duration,
        "reason": timed.reason, "computed": query.times["timing"] + query.times["timing proof"],
    }  # fmt: skip


def motions_of(results: Results, jobs: int, commit: str, quiet: bool = False) -> list[dict[str, Any]]:
    """Return the motions of all solved runs, see :func:`motion_of`; each is kept, with the commit, when it is made.

    Args:
        results: Results of runs whose paths are stored.
        jobs: Number of motions made at the same time, each in a process of its own.
        commit: Commit of the code.
        quiet: Whether to show no progress.

    Raises:
        ApexError: A path is not stored.
    """
    file = results.folder / MOTIONS
    lines = file.read_text().splitlines(keepends=True) if file.exists() else []
    whole = [line for line in lines if line.endswith("\n")]  # a killed process left an incomplete line
    write_atomically(file, "".join(whole).encode())
    made = {motion["key"]: motion for motion in map(json.loads, whole)}
    solved = [run for run in results.runs if run["solved"]]
    left = [run for run in solved if run["key"] not in made]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool, file.open("a") as out:
        tasks = [pool.submit(motion_of, run, results.plan_file(run)) for run in left]
        for task in tqdm(as_completed(tasks), total=len(left), unit="motion", disable=quiet):
            motion = task.result() | {"commit": commit}
            made[motion["key"]] = motion
            out.write(json.dumps(motion) + "\n")
            out.flush()
    return [made[run["key"]] for run in solved]


def with_motions(results: Results, made: Sequence[Mapping[str, Any]]) -> Results:
    """Return results with planning + motion of solved runs, column WAIT, infinite where the motion failed [s]."""
    seconds = {m["key"]: math.inf if m["duration"] is None else m["computed"] + m["duration"] for m in made}
    runs = [run | {WAIT: run["total"] + seconds[run["key"]]} if run["solved"] else run for run in results.runs]
    return replace(results, runs=runs)


def together(
    found: Sequence[Statistics], wanted: Sequence[Row] = ROWS, groups: Mapping[str, Sequence[str]] = GROUPS
) -> Table:
    """Return the statistics of each row over levels together, with its lengths over those of apex.

    Where runs have the column WAIT, its percentiles are given, and the number of motions that failed.

    Args:
        found: Statistics of the rows on each level.
        wanted: The rows.
        groups: Name of a group -> its levels, as ``shelf/hard``, or ``hard`` for those of all suites.
    """
    rows, timed = [], any(WAIT in run for f in found for run in f.solved)
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
            waits = [_seconds(f.percentile(WAIT, p)) for p in WAITS] if timed else []
            waits += [str(sum(math.isinf(run[WAIT]) for run in f.solved))] if timed else []
            rows.append([
                group, row.label, str(len(f.runs)),
                f"{len(f.solved) / len(f.runs):.3f} ({low:.3f} to {high:.3f})", *shares,
                *(f"{1e3 * t:.0f}" if math.isfinite(t) else "-" for t in times),
                f"{math.exp(np.mean(both)):.2f} ({len(both)})" if both else "-", *waits,
            ])  # fmt: skip
    within = [f"in {t:g} s" for t in SHARE_TIMES]
    head = ["levels", "planner", "N", "solved (95 %, Wilson)", *within, "first path p50 ms", "p95", "p99", "end p50 ms"]
    head += ["length / apex's (problems that both solved)"]
    head += ["planning + motion p50 s", "p95", "motions that failed"] if timed else []
    return Table("Levels together", head, rows)


def _seconds(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=30, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument(
        "--slow", type=one_or_more, default=SLOW, help="of them for rows that take long (default: %(default)s)"
    )
    args = parser.parse_args()
    workers = Workers(args.jobs)
    rows = [row if row.runs is None else replace(row, runs=args.slow) for row in ROWS]
    levels, seeds = record.static_levels(args.levels), {row.label: min(args.n, row.runs or args.n) for row in rows}
    results = bench(
        levels, rows, FOLDER, runs=args.n, timeout=TIMEOUT, workers=workers, keep=True, provenance=record.session()
    )
    results = replace(results, runs=[run for run in results.runs if run["seed"] < seeds.get(run["label"], 0)])
    write_database(results, write_logs(results))
    report(FOLDER, FOLDER)
    made = motions_of(results, args.jobs, record.session()["commit"])
    together_table = together(statistics(with_motions(results, made)))
    found = [table for table in (together_table, *tables(results)) if table.rows]
    text = "\n\n".join([*warnings(results), *(table.markdown() for table in found)])
    data = {"tables": [{"title": t.title, "head": list(t.head), "rows": [list(r) for r in t.rows]} for t in found]}
    about = {"timeout": f"{TIMEOUT:g} s but for rows with their own", "seeds": "0 to N - 1"}
    made_with = record.made_with(results)
    made_with["run_commits"] = "; ".join(sorted({*made_with["run_commits"].split("; "), *(m["commit"] for m in made)}))
    record.write("head_to_head", data, text, split="test", **about, **made_with)


if __name__ == "__main__":
    run_script(main)
