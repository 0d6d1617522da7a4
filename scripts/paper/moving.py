"""Figures among moving cubes, in the closed loop on the simulated clock: failure ratio by task, over size, sweeps.

``dynamic`` has cubes that pass, and go on whatever the robot does; ``imposed`` those that are brought into the way of
the first motion, and stand, half of them to be moved once more: the paper's experiment. Those are worlds of the kind
``imposed`` (:mod:`apex_ompl.problems.world_imposed`) around the problems of the levels without obstacles.

Each run is a row's own function to the benchmark (:class:`apex_ompl.evaluation.Row`), so that the runs are stored, and
resume, as all others do. The same seed gives the same run on a loaded machine, too.
"""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Sequence
from typing import Any

import numpy as np
from paper.figure import Made, blank, cost_of, number, of_runs
from paper.motions import smoothness
from paper.rows import (
    BOTH,
    BROUGHT_IN,
    CENTRAL_IMPOSED,
    CENTRAL_LABELS,
    CLAIMED_MOVING,
    FAITHFUL,
    FREE,
    IMPOSED,
    LARGEST_MOVING,
    METHODS,
    MOVING,
    OURS,
    PACE,
    SWEEPS,
    SWEPT,
    TASKS,
    UNGUIDED,
    brought,
    installed,
)  # fmt: skip
from paper.static import HEAD, errorbars, evenly, measured, of_task, runs_of, with_causes
from paper.static import median as median_of

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
LARGEST = "huge"
MORE = (*HEAD, "causes", "time to goal s", "replans")
MOVED_ONCE = 3  # places in the script of a cube that was brought in: where it came into view, began to move, and stands


def loop_result(problem: str, method: str, seed: int, limit: float, params: dict[str, Any]) -> RunResult:
    """Return a run of the closed loop with parameters of a row of :mod:`paper.rows`.

    Raises:
        ApexError: The world, the replanner or a parameter is unknown or faulty.
    """
    changed = {name: value for name, value in params.items() if name not in ("speed", "prediction", "size")}
    settings = LoopSettings(**{"timeout": limit, **changed})
    prediction = params.get("prediction", settings.prediction)
    suite, _, number = problem.split("/")
    if "size" in params and suite in TASKS:  # not where a process warms up on another problem
        problem = f"imposed/{suite}/{params['size']}/{number}"
    return run(problem, method, prediction=prediction, seed=seed, speed=params["speed"], settings=settings)


def loop_run(job: Job) -> Run:
    """Return the columns of a run of the closed loop, with its CPU time [s] and how often its cube was brought in."""
    begin = time.process_time()
    result = loop_result(job.problem, job.planner, job.seed, job.timeout, dict(job.params))
    cpu = time.process_time() - begin
    scripts = [o.trajectory or () for o in result.problem.scene if o.name in result.problem.moving]
    return {
        "solved": bool(result), "outcome": str(result.outcome), "reason": result.reason, "cpu": cpu,
        "length": path_length(result.trajectory.sample(SAMPLES).position), "costs": cost_table()["version"],
        **(smoothness(result.trajectory) if result.trajectory.duration > 0.0 else {}),
        "brought": sum(1 + (len(script) > MOVED_ONCE) for script in scripts),
        **{name: result.metrics.get(name) for name in KEPT},
    }  # fmt: skip


def loop_runs(
    args: Namespace, levels: Sequence[str] = (), labels: Sequence[str] = ()
) -> tuple[tuple[Row, ...], Results]:
    """Return the rows of this installation, and their runs, the central claim's first.

    All of them unless levels and labels are given.
    """
    rows = installed([row for row in (*METHODS, *SWEEPS) if not labels or row.label in labels], methods.names())
    some = [(levels or list(MOVING), rows)]
    claimed = [] if levels or labels else [(LARGEST_MOVING, installed(CLAIMED_MOVING, methods.names()))]
    return rows, runs_of(args, [*claimed, *some], "paper_loops", jobs=args.jobs, timeout=LIMIT)


def dynamic(args: Namespace) -> Made:
    """Return failure ratios by task and over size, and what each choice of the loop changes."""
    rows, results = loop_runs(args)
    everywhere = [row for row in rows if not row.levels]
    data: dict[str, Any] = {"tasks": {}, "sizes": {}, "sweeps": {}, "cost": cost_of(results)}
    by_task, by_size, sweeps = [], [], []
    for row in everywhere:
        for task in (*TASKS, BOTH):
            mine = evenly(of_task(results.runs, task, row.label))
            if mine:
                cell = data["tasks"][f"{task}, {row.label}"] = told(mine)
                by_task.append([task, row.label, *told_cells(cell)])
        for size in SIZES:
            mine = [run for run in results.runs if run["label"] == row.label and MOVING[run["experiment"]] == size]
            if mine:
                cell = data["sizes"][f"{size}, {row.label}"] = told(mine)
                by_size.append([size, row.label, *told_cells(cell)])
    compared = [row for row in rows if row.label in (FAITHFUL, UNGUIDED, OURS) or row.levels]
    for row in compared:
        mine = [run for run in results.runs if run["label"] == row.label and run["experiment"] in SWEPT]
        if mine:
            cell = data["sweeps"][row.label] = told(mine)
            sweeps.append(["large", row.label, *told_cells(cell)])
    notes, commits = of_runs(results, planned=False)
    notes += loop_notes(results)
    tables = [
        Table("Failure ratio among moving cubes", ["task", "method", *MORE], by_task),
        Table("Failure ratio over the size of moving cubes", ["size", "method", *MORE], by_size),
        Table("One choice changed at a time, large cubes", ["size", "method", *MORE], sweeps),
    ]
    return Made(data, tables, notes, drawn(data["sizes"], [row.label for row in everywhere]), commits)


def imposed(args: Namespace) -> Made:
    """Return failure ratios over size where a cube is brought into the way, and stands; of the runs in which one was.

    A cube comes where there is room for it in the way of the method's own first motion, so that not all runs have one.
    """
    known, parts = methods.names(), [(FREE, brought(LARGEST, CENTRAL_IMPOSED, CENTRAL_LABELS))]
    parts += [(FREE, installed(brought(size, IMPOSED, BROUGHT_IN), known)) for size in SIZES]
    results = runs_of(args, parts, "paper_imposed", jobs=args.jobs, timeout=LIMIT)
    data: dict[str, Any] = {"sizes": {}, "tasks": {}, "again": {}, "cost": cost_of(results)}
    lines: dict[str, list[list[str]]] = {name: [] for name in ("sizes", "tasks", "again")}

    def add(table: str, name: str, label: str, runs: Sequence[Run], worlds: Sequence[Run]) -> None:
        if runs:
            cell = data[table][f"{name}, {label}"] = told(runs) | {"worlds": len(worlds)}
            lines[table].append([name, label, str(len(worlds)), *told_cells(cell)])

    for label in BROUGHT_IN:
        for size in SIZES:
            every = [run for run in results.runs if run["label"] == f"{label}, {size}"]
            mine = [run for run in every if run.get("brought")]
            add("sizes", size, label, mine, every)
            if size == LARGEST:
                for task in TASKS:
                    add("tasks", task, label, [r for r in mine if r["experiment"].startswith(task)],
                        [r for r in every if r["experiment"].startswith(task)])  # fmt: skip
                for name, times in (("stood", 1), ("moved again", 2)):
                    add("again", name, label, [r for r in mine if r["brought"] == times], every)
    notes, commits = of_runs(results, planned=False)
    notes += [*loop_notes(results), ("N", "runs in which there was room for a cube, of all worlds that were tried")]
    titles = {"sizes": ("Failure ratio over the size of cubes that are brought in", "size"),
              "tasks": ("Cubes of 30 cm by task", "task"),
              "again": ("Cubes of 30 cm that stood to the end of the run, or were moved again", "cube")}  # fmt: skip
    tables = [Table(title, [first, "method", "worlds", *MORE], lines[name]) for name, (title, first) in titles.items()]
    return Made(data, tables, notes, drawn(data["sizes"], BROUGHT_IN), commits)


def loop_notes(results: Results) -> list[tuple[str, Any]]:
    """Return how runs of the loop are made."""
    versions = "; ".join(sorted({str(run["costs"]) for run in results.runs if "costs" in run}))
    return [
        ("Loop", f"{LIMIT:g} s at most, {PACE:g} of the velocity limits, replans charged by the table of costs, "
                 f"version {versions}; ideal: its answer is known at once"),
        ("Sensor", "30 Hz, 50 ms late, errors of 8 mm, 2 % missed"),
        ("S_r, duration, jerk", "medians over the runs that reached the goal, of the executed motion with its stops; "
                                "jerk: root mean square over time"),
    ]  # fmt: skip


def told(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the numbers of some runs of one row."""
    replans = [run["replans_asked"] for run in runs if run.get("replans_asked") is not None]
    return measured(runs) | {
        "time_to_goal_s": median_of(runs, "time_to_goal"),
        "replans": float(np.mean(replans)) if replans else None,
    }  # fmt: skip


def told_cells(cell: dict[str, Any]) -> list[str]:
    """Return them as the tables have them, under ``MORE``."""
    return [*with_causes(cell), number(cell["time_to_goal_s"]), number(cell["replans"], 1)]


def drawn(sizes: dict[str, Any], labels: Sequence[str]) -> Any:
    """Return a picture of failure ratios over size, replans charged and, where there are such rows, ideal."""
    kinds = [kind for kind in (False, True) if any(label.endswith(IDEAL) == kind for label in labels)]
    picture = blank(5 * len(kinds), 4.8)
    for axis, ideal in zip(np.atleast_1d(picture.subplots(1, len(kinds), sharey=True)), kinds, strict=True):
        shown = [label for label in labels if label.endswith(IDEAL) == ideal]
        for k, label in enumerate(shown):
            there = {SIZES[size]: sizes[f"{size}, {label}"] for size in SIZES if f"{size}, {label}" in sizes}
            errorbars(axis, there, label.removesuffix(IDEAL), 0.0012 * (k - len(shown) / 2),
                      main=label.startswith((FAITHFUL, OURS)))  # fmt: skip
        axis.set_title("replans take no time" if ideal else "replans are charged")
        axis.set_xlabel("edge of the moving cube m")
        axis.set_ylim(-2.0, 102.0)
        axis.grid(alpha=0.3)
    picture.axes[0].set_ylabel("R_f %")
    picture.legend(*picture.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return picture
