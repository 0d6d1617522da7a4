"""Figures among moving cubes, in the closed loop on the simulated clock: failure ratio by task, over size, sweeps.

Each run is a row's own function to the benchmark (:class:`apex_ompl.evaluation.Row`), so that the runs are stored, and
resume, as all others do. The same seed gives the same run on a loaded machine, too.
"""

from __future__ import annotations

from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from paper.figure import Made, blank, number, of_runs, ratio, ratio_cells
from paper.rows import BOTH, FAITHFUL, METHODS, MOVING, OURS, PACE, SWEEPS, SWEPT, TASKS, UNGUIDED, color, installed
from paper.static import median, of_task, runs_of

from apex_ompl import run
from apex_ompl.evaluation import Results, Row
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.evaluation.summary import Table
from apex_ompl.loop.replan import methods
from apex_ompl.loop.result import RunResult
from apex_ompl.moving.compute_costs import cost_table
from apex_ompl.moving.settings import LoopSettings
from apex_ompl.paths.path import path_length
from apex_ompl.problems.alignment import SIZES

LIMIT = 30.0  # of a run [s]
SAMPLES = 0.01  # between samples of an executed motion for S_r [s]
KEPT = ("time_to_goal", "stops", "rest_time", "replans_asked", "replans_accepted", "clearance", "broken_steps")
IDEAL = ", ideal"


def loop_result(problem: str, method: str, seed: int, limit: float, params: dict[str, Any]) -> RunResult:
    """Return a run of the closed loop with parameters of a row of :mod:`paper.rows`.

    Raises:
        ApexError: The world, the replanner or a parameter is unknown or faulty.
    """
    changed = {name: value for name, value in params.items() if name not in ("speed", "prediction")}
    settings = LoopSettings(**{"timeout": limit, **changed})
    prediction = params.get("prediction", settings.prediction)
    return run(problem, method, prediction=prediction, seed=seed, speed=params["speed"], settings=settings)


def loop_run(job: Job) -> Run:
    """Return the columns of a run of the closed loop."""
    result = loop_result(job.problem, job.planner, job.seed, job.timeout, dict(job.params))
    return {
        "solved": bool(result), "outcome": str(result.outcome), "reason": result.reason,
        "length": path_length(result.trajectory.sample(SAMPLES).position), "costs": cost_table()["version"],
        **{name: result.metrics.get(name) for name in KEPT},
    }  # fmt: skip


def loop_runs(
    args: Namespace, levels: Sequence[str] = (), labels: Sequence[str] = ()
) -> tuple[tuple[Row, ...], Results]:
    """Return the rows of this installation, and their runs; all of them unless levels and labels are given."""
    rows = [row for row in (*METHODS, *SWEEPS) if not labels or row.label in labels]
    there = installed(rows, methods.names())
    return there, runs_of(args, levels or list(MOVING), there, "paper_loops", jobs=args.jobs, timeout=LIMIT)


def dynamic(args: Namespace) -> Made:
    """Return failure ratios by task and over size, and what each choice of the loop changes."""
    rows, results = loop_runs(args)
    everywhere = [row for row in rows if not row.levels]
    data: dict[str, Any] = {"tasks": {}, "sizes": {}, "sweeps": {}}
    by_task, by_size, sweeps = [], [], []
    for row in everywhere:
        for task in (*TASKS, BOTH):
            mine = of_task(results.runs, task, row.label)
            cell = data["tasks"][f"{task}, {row.label}"] = told(mine)
            by_task.append([task, row.label, *cells(cell)])
        for size in SIZES:
            mine = [run for run in results.runs if run["label"] == row.label and MOVING[run["experiment"]] == size]
            cell = data["sizes"][f"{size}, {row.label}"] = ratio(run["solved"] for run in mine)
            by_size.append([size, row.label, *ratio_cells(cell)])
    compared = [row for row in rows if row.label in (FAITHFUL, UNGUIDED, OURS) or row.levels]
    for row in compared:
        mine = [run for run in results.runs if run["label"] == row.label and run["experiment"] in SWEPT]
        cell = data["sweeps"][row.label] = told(mine)
        sweeps.append(["large", row.label, *cells(cell)])
    head = ["N", "R_f %", "95 %"]
    more = [*head, "causes", "S_r rad", "time to goal s", "replans"]
    notes, commits = of_runs(results, planned=False)
    versions = "; ".join(sorted({str(run["costs"]) for run in results.runs if "costs" in run}))
    notes += [
        ("Loop", f"{LIMIT:g} s at most, {PACE:g} of the velocity limits, replans charged by the table of costs, "
                 f"version {versions}; ideal: its answer is known at once"),
        ("Sensor", "30 Hz, 50 ms late, errors of 8 mm, 2 % missed"),
    ]  # fmt: skip
    tables = [
        Table("Failure ratio among moving cubes", ["task", "method", *more], by_task),
        Table("Failure ratio over the size of moving cubes", ["size", "method", *head], by_size),
        Table("One choice changed at a time, large cubes", ["size", "method", *more], sweeps),
    ]
    return Made(data, tables, notes, drawn(data["sizes"], everywhere), commits)


def told(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the numbers of some runs of one row."""
    causes = Counter(run.get("outcome", "crash") for run in runs if not run["solved"])
    replans = [run["replans_asked"] for run in runs if run.get("replans_asked") is not None]
    return ratio(run["solved"] for run in runs) | {
        "causes": dict(causes.most_common()), "S_r": median(runs, "length"),
        "time_to_goal_s": median(runs, "time_to_goal"), "replans": float(np.mean(replans)) if replans else None,
    }  # fmt: skip


def cells(cell: dict[str, Any]) -> list[str]:
    """Return the numbers of a row as the tables have them."""
    causes = ", ".join(f"{count} {cause}" for cause, count in cell["causes"].items()) or "-"
    numbers = [number(cell["S_r"]), number(cell["time_to_goal_s"]), number(cell["replans"], 1)]
    return [*ratio_cells(cell), causes, *numbers]


def drawn(sizes: dict[str, Any], rows: Sequence[Row]) -> Any:
    """Return a picture of failure ratios over size, replans charged and ideal."""
    picture = blank(10, 4.8)
    for axis, ideal in zip(picture.subplots(1, 2, sharey=True), (False, True), strict=True):
        shown = [row for row in rows if row.label.endswith(IDEAL) == ideal]
        for k, row in enumerate(shown):
            found = [sizes[f"{size}, {row.label}"] for size in SIZES]
            line = np.array([cell["R_f"] for cell in found])
            ends = np.abs(np.transpose([cell["interval"] for cell in found]) - line)
            at = np.array(list(SIZES.values())) + 0.0012 * (k - len(shown) / 2)  # beside each other
            ours = row.label.startswith((FAITHFUL, OURS))
            axis.errorbar(at, line, ends if ours else None, fmt="--" if "unguided" in row.label else "-", marker="o",
                          color=color(row.label), linewidth=1.6 if ours else 0.9, elinewidth=0.8,
                          label=row.label.removesuffix(IDEAL))  # fmt: skip
        axis.set_title("replans take no time" if ideal else "replans are charged")
        axis.set_xlabel("edge of the moving cube m")
        axis.set_ylim(-2.0, 102.0)
        axis.grid(alpha=0.3)
    picture.axes[0].set_ylabel("R_f %")
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return picture
