"""Figures in static scenes: failure ratio and smoothness by task, failure ratio over size, planning time."""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from paper.figure import ASKED, Made, blank, cost_of, number, of_runs, ratio, ratio_cells
from paper.rows import (
    BOTH,
    CLAIMED,
    LARGEST,
    OVER_SIZE,
    PACE,
    PLANNERS,
    STATIC,
    TASKS,
    color,
    installed,
    untrained,
)  # fmt: skip

from apex_ompl import planners
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.metrics import next_percentile
from apex_ompl.evaluation.rows import jobs as jobs_of
from apex_ompl.evaluation.runs import CRASH, NO_PROBLEM, Run
from apex_ompl.evaluation.summary import Table
from benchmarks.lib import record

TIMEOUT = 10.0  # [s]
TIMED = "large"
FOLDER = "paper_static"
HEAD = ("N", "R_f %", "95 %", "S_r rad", "duration s", "jerk rad/s^3")
SMOOTH = (
    "S_r, duration, jerk",
    "medians over the solved; the last two are of the motion along the path at "
    f"{PACE:g} of the velocity limits; jerk: root mean square over time",
)
CAUSES = ("Causes", "of one sample: what the path meets first, a cube or the robot itself with what it holds")
Part = tuple[Sequence[str], Sequence[Row]]
"""Levels, and rows that have their numbers of runs on each of them."""


def runs_of(
    args: Namespace, parts: Sequence[Part], folder: str, *, jobs: int, timeout: float = TIMEOUT, split: str = "test"
) -> Results:
    """Return the runs of some rows on the first problems of some levels, one part after the other.

    Missing ones are made, with the argument ``parts`` those of the first so many parts alone, with ``report`` none.
    """
    out, wanted = args.keep / folder, dict[str, str]()
    for k, (levels, rows) in enumerate(part for part in parts if part[1]):
        there = jobs_of(levels, rows, runs=args.n, timeout=timeout, seed=0, split=split, simplify=True)
        wanted |= {job.key: job.label for job in there}
        if not args.report and (args.parts is None or k < args.parts):
            bench(levels, rows, out, runs=args.n, timeout=timeout, workers=Workers(jobs), split=split,
                  provenance=record.session())  # fmt: skip
    found = Results.load(out)
    mine = [run for run in found.runs if run["key"] in wanted and run["status"] != NO_PROBLEM]
    return replace(found, runs=mine, about={**found.about, ASKED: Counter(wanted.values())})


def median(runs: Sequence[Run], column: str) -> float | None:
    """Return the median of a column over the solved runs that have it."""
    values = [run[column] for run in runs if run["solved"] and run.get(column) is not None]
    return float(np.median(values)) if values else None


def of_task(runs: Sequence[Run], task: str, label: str) -> list[Run]:
    """Return the runs of a row on a task, or on both."""
    return [run for run in runs if run["label"] == label and task in (BOTH, run["experiment"].split("/")[0])]


def evenly(runs: Sequence[Run]) -> list[Run]:
    """Return the first runs of a row on each of its levels, as many as there are on the level that has the fewest.

    Levels of the central claim have more runs, and would weigh more in what all sizes have in common.
    """
    by_level: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: int(run["seed"])):
        by_level.setdefault(run["experiment"], []).append(run)
    fewest = min(map(len, by_level.values()), default=0)
    return [run for some in by_level.values() for run in some[:fewest]]


def standing(args: Namespace, over_size: bool) -> tuple[tuple[Row, ...], Results]:
    """Return the rows of all planners, or of those over size, and their runs: the central claim's, then quick ones."""
    rows = installed(PLANNERS[:OVER_SIZE] if over_size else PLANNERS, planners.names())
    claimed, quick = [row for row in CLAIMED if not untrained(row)], [row for row in rows if row.timeout is None]
    parts = [(LARGEST, claimed), (list(STATIC), quick), (list(STATIC), rows)]
    return rows, runs_of(args, parts, FOLDER, jobs=args.jobs)


def failure(args: Namespace) -> Made:
    """Return R_f, S_r, and duration and jerk of all planners by task, over all sizes of cubes."""
    rows, results = standing(args, over_size=False)
    among = [run for run in results.runs if STATIC[run["experiment"]]]
    data: dict[str, Any] = {}
    lines, picture = [], blank(11, 4.6)
    for task in (*TASKS, BOTH):
        for row in rows:
            mine = evenly(of_task(among, task, row.label))
            if not mine:
                continue
            cell = data[f"{task}, {row.label}"] = measured(mine)
            lines.append([task, row.label, *cells(cell)])
    for axis, key in zip(picture.subplots(1, 2), ("R_f", "S_r"), strict=True):
        for t, task in enumerate(TASKS):
            for k, row in enumerate(rows):
                cell, at = data.get(f"{task}, {row.label}"), t * (len(rows) + 1) + k
                if cell is None:
                    continue
                axis.bar(at, cell[key] or 0.0, color=color(row.label), label=None if t else row.label)
                if key == "R_f":
                    axis.plot([at, at], cell["interval"], color="black", linewidth=1)
        axis.set_title({"R_f": "R_f %", "S_r": "S_r rad, median of the solved"}[key])
        middle = (len(rows) - 1) / 2
        axis.set_xticks([middle, middle + len(rows) + 1], TASKS)
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    head = ["task", "planner", *HEAD]
    notes, commits = of_runs(results)
    data["cost"] = cost_of(results)
    notes.append(SMOOTH)
    return Made(data, [Table("Failure ratio and smoothness", head, lines)], notes, picture, commits)


def size(args: Namespace) -> Made:
    """Return the failure ratio over the size of the cubes, guided and not."""
    rows, results = standing(args, over_size=True)
    data: dict[str, Any] = {}
    lines, picture = [], blank(9, 4.6)
    for axis, task in zip(picture.subplots(1, 2, sharey=True), TASKS, strict=True):
        for k, row in enumerate(rows):
            over = {}
            for level in (level for level in STATIC if level.startswith(f"{task}/")):
                mine = [run for run in results.runs if (run["experiment"], run["label"]) == (level, row.label)]
                if mine:
                    over[STATIC[level]] = data[f"{level}, {row.label}"] = measured(mine)
                    lines.append([task, row.label, f"{STATIC[level]:.2f}", *with_causes(over[STATIC[level]])])
            errorbars(axis, over, row.label, 0.0015 * (k - len(rows) / 2))
        axis.set_title(task)
        axis.set_xlabel("edge of the cubes m")
        axis.grid(alpha=0.3)
    for row in PLANNERS[:OVER_SIZE]:
        for name in dict.fromkeys(level.split("/")[1] for level in STATIC):
            mine = [run for run in of_task(results.runs, BOTH, row.label) if run["experiment"].endswith(f"/{name}")]
            if mine:
                cell = data[f"{BOTH}/{name}, {row.label}"] = measured(mine)
                lines.append([BOTH, row.label, f"{STATIC[f'{TASKS[0]}/{name}']:.2f}", *with_causes(cell)])
            elif untrained(row):
                data[f"{BOTH}/{name}, {row.label}"] = {"why": "not trained"}
    picture.axes[0].set_ylabel("R_f %")
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    head = ["task", "planner", "edge m", *HEAD, "causes"]
    notes, commits = of_runs(results)
    data["cost"] = cost_of(results)
    notes += [SMOOTH, CAUSES]
    return Made(data, [Table("Failure ratio over the size of obstacles", head, lines)], notes, picture, commits)


def measured(runs: Sequence[Run]) -> dict[str, Any]:
    """Return failure ratio, and medians of S_r, duration and jerk over the solved, of some runs of a row.

    With the number of failures by ``causes``, where the runs tell them.
    """
    columns = {"S_r": "length", "duration_s": "duration", "rms_jerk": "rms_jerk"}
    found = ratio(run["solved"] for run in runs) | {name: median(runs, column) for name, column in columns.items()}
    if all("outcome" in run or run["status"] == CRASH for run in runs):
        failed = Counter(run.get("outcome", "crash") for run in runs if not run["solved"])
        found["causes"] = dict(failed.most_common())
    return found


def with_causes(cell: Mapping[str, Any]) -> list[str]:
    """Return what :func:`cells` does, and the causes of failures."""
    causes = cell.get("causes", {})
    return [*cells(cell), ", ".join(f"{count} {name}" for name, count in causes.items()) or "-"]


def cells(cell: Mapping[str, Any]) -> list[str]:
    """Return them as the tables have them, under ``HEAD``."""
    return [*ratio_cells(cell), *(number(cell[name]) for name in ("S_r", "duration_s", "rms_jerk"))]


def errorbars(
    axis: Any, over: Mapping[float, Mapping[str, Any]], label: str, aside: float, *, main: bool = True
) -> None:
    """Draw the failure ratios of a row over size.

    Args:
        axis: Where they are drawn.
        over: Edge of the cubes [m] to the row's numbers.
        label: The row.
        aside: Distance to the side, beside other rows [m].
        main: Whether the row is drawn with its intervals, and thicker.
    """
    if over:
        line = np.array([cell["R_f"] for cell in over.values()])
        ends = np.abs(np.transpose([cell["interval"] for cell in over.values()]) - line)
        axis.errorbar(np.array(list(over)) + aside, line, ends if main else None, marker="o", color=color(label),
                      fmt="--" if "unguided" in label else "-", linewidth=1.5 if main else 0.9, elinewidth=0.8,
                      label=label)  # fmt: skip


def time(args: Namespace) -> Made:
    """Return planning times; one run is made at a time, whatever ``jobs`` is."""
    rows = installed(PLANNERS, planners.names())
    results = runs_of(args, [([f"{task}/{TIMED}" for task in TASKS], rows)], "paper_alone", jobs=1)
    data: dict[str, Any] = {}
    lines = []
    for row in rows:
        mine = of_task(results.runs, BOTH, row.label)
        if not mine:
            continue
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
    data["cost"] = cost_of(results)
    return Made(data, [Table("Planning time", head, lines)], notes, None, commits)
