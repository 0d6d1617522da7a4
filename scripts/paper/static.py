"""Figures in scenes that stand still: failure ratio and smoothness by task, failure ratio over size, planning time."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from paper.figure import Made, blank, number, of_runs, ratio, ratio_cells
from paper.rows import BOTH, PLANNERS, STATIC, TASKS, color, installed

from apex_ompl import planners
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.metrics import next_percentile
from apex_ompl.evaluation.rows import jobs as jobs_of
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.evaluation.summary import Table
from benchmarks.lib import record

TIMEOUT = 10.0  # [s]
OVER_SIZE = 7  # the first so many rows are those of the figure over size: apex, and each model guided and not
TIMED = "large"
FEW, SHARE = 2, 4  # of planners that are so slow that they have their own time limit: least runs, and divisor of runs


def runs_of(
    args: Namespace, levels: Sequence[str], rows: Sequence[Row], folder: str, *, jobs: int, timeout: float = TIMEOUT,
    split: str = "test",
) -> Results:  # fmt: skip
    """Return the runs of some rows on the first problems of some levels, made where they are missing."""
    rows = [replace(row, runs=max(FEW, args.n // SHARE)) if row.timeout else row for row in rows]
    found = bench(
        levels, rows, args.keep / folder, runs=args.n, timeout=timeout, workers=Workers(jobs),
        split=split, provenance=record.session(),
    )  # fmt: skip
    wanted = jobs_of(levels, rows, runs=args.n, timeout=timeout, seed=0, split=split, simplify=True)
    keys = {job.key for job in wanted}  # a folder may have runs with parameters of an earlier day, too
    return replace(found, runs=[run for run in found.runs if run["key"] in keys and run["status"] != NO_PROBLEM])


def median(runs: Sequence[Run], column: str) -> float | None:
    """Return the median of a column over the solved runs that have it."""
    values = [run[column] for run in runs if run["solved"] and run.get(column) is not None]
    return float(np.median(values)) if values else None


def of_task(runs: Sequence[Run], task: str, label: str) -> list[Run]:
    """Return the runs of a row on a task, or on both."""
    return [run for run in runs if run["label"] == label and task in (BOTH, run["experiment"].split("/")[0])]


def failure(args: Namespace) -> Made:
    """Return R_f and S_r of all planners by task, over all sizes of cubes."""
    rows = installed(PLANNERS, planners.names())
    results = runs_of(args, list(STATIC), rows, "paper_figures", jobs=args.jobs)
    among = [run for run in results.runs if STATIC[run["experiment"]]]
    data: dict[str, Any] = {}
    lines, picture = [], blank(11, 4.6)
    for task in (*TASKS, BOTH):
        for row in rows:
            mine = of_task(among, task, row.label)
            cell = ratio(run["solved"] for run in mine)
            cell |= {"S_r": median(mine, "length"), "S_r as found": median(mine, "raw_length")}
            data[f"{task}, {row.label}"] = cell
            lines.append([task, row.label, *ratio_cells(cell), number(cell["S_r"]), number(cell["S_r as found"])])
    for axis, key in zip(picture.subplots(1, 2), ("R_f", "S_r"), strict=True):
        for t, task in enumerate(TASKS):
            for k, row in enumerate(rows):
                cell, at = data[f"{task}, {row.label}"], t * (len(rows) + 1) + k
                axis.bar(at, cell[key] or 0.0, color=color(row.label), label=None if t else row.label)
                if key == "R_f":
                    axis.plot([at, at], cell["interval"], color="black", linewidth=1)
        axis.set_title({"R_f": "R_f %", "S_r": "S_r rad, median of the solved"}[key])
        middle = (len(rows) - 1) / 2
        axis.set_xticks([middle, middle + len(rows) + 1], TASKS)
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    head = ["task", "planner", "N", "R_f %", "95 %", "S_r rad (median of solved)", "as found"]
    notes, commits = of_runs(results)
    return Made(data, [Table("Failure ratio and smoothness", head, lines)], notes, picture, commits)


def size(args: Namespace) -> Made:
    """Return the failure ratio over the size of the cubes, guided and not."""
    rows = PLANNERS[:OVER_SIZE]
    results = runs_of(args, list(STATIC), rows, "paper_figures", jobs=args.jobs)
    data: dict[str, Any] = {}
    lines, picture = [], blank(9, 4.6)
    for axis, task in zip(picture.subplots(1, 2, sharey=True), TASKS, strict=True):
        levels = [level for level in STATIC if level.startswith(f"{task}/")]
        for k, row in enumerate(rows):
            cells = []
            for level in levels:
                mine = [
                    run["solved"] for run in results.runs if (run["experiment"], run["label"]) == (level, row.label)
                ]
                cells.append(ratio(mine))
                data[f"{level}, {row.label}"] = cells[-1]
                lines.append([task, row.label, f"{STATIC[level]:.2f}", *ratio_cells(cells[-1])])
            line = [cell["R_f"] for cell in cells]
            ends = np.transpose([(c["R_f"] - c["interval"][0], c["interval"][1] - c["R_f"]) for c in cells])
            at = np.array([STATIC[level] for level in levels]) + 0.0015 * (k - len(rows) / 2)  # beside each other
            style = "--" if "unguided" in row.label else "-"
            axis.errorbar(at, line, np.maximum(ends, 0.0), fmt=style, color=color(row.label), marker="o",
                          linewidth=1.5, elinewidth=0.8, label=row.label)  # fmt: skip
        axis.set_title(task)
        axis.set_xlabel("edge of the cubes m")
        axis.grid(alpha=0.3)
    for row in rows:
        for name in sorted({level.split("/")[1] for level in STATIC}):
            mine = [run for run in results.runs if run["experiment"].endswith(f"/{name}")]
            data[f"{BOTH}/{name}, {row.label}"] = ratio(run["solved"] for run in mine if run["label"] == row.label)
    picture.axes[0].set_ylabel("R_f %")
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    head = ["task", "planner", "edge m", "N", "R_f %", "95 %"]
    notes, commits = of_runs(results)
    return Made(data, [Table("Failure ratio over the size of obstacles", head, lines)], notes, picture, commits)


def time(args: Namespace) -> Made:
    """Return planning times; whatever is asked for, one run goes at a time."""
    rows = installed(PLANNERS, planners.names())
    results = runs_of(args, [f"{task}/{TIMED}" for task in TASKS], rows, "paper_times", jobs=1)
    data: dict[str, Any] = {}
    lines = []
    for row in rows:
        mine = of_task(results.runs, BOTH, row.label)
        solved = [run["total"] for run in mine if run["solved"]]
        every = [run["total"] if run["solved"] else np.inf for run in mine]
        middle, late = (next_percentile(every, p) for p in (50.0, 95.0))
        cell = {
            "N": len(mine), "solved": len(solved), "time_s": middle if np.isfinite(middle) else None,
            "p95_s": late if np.isfinite(late) else None, "of solved_s": float(np.median(solved)) if solved else None,
        }  # fmt: skip
        data[row.label] = cell
        times = [number(cell[key], 3) for key in ("time_s", "p95_s", "of solved_s")]
        lines.append([row.label, str(len(mine)), str(len(solved)), *times])
    head = ["planner", "N", "solved", "median of all s", "p95 of all s", "median of the solved s"]
    notes, commits = of_runs(results)
    return Made(data, [Table("Planning time", head, lines)], notes, None, commits)
