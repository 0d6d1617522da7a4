"""Examples of runs among moving cubes, picked by rule and drawn: strips with and without guidance, and failures."""

from __future__ import annotations

import tempfile
from argparse import Namespace
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from paper.figure import Made, blank, of_runs
from paper.moving import LIMIT, loop_result, loop_runs
from paper.rows import FAITHFUL, MOVING, TASKS, UNGUIDED

from apex_ompl.evaluation.runs import Run
from apex_ompl.evaluation.summary import Table
from apex_ompl.loop.referee import judge
from apex_ompl.loop.result import Outcome, RunResult
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import Trajectory

STRIP_LEVELS = {"small": f"{TASKS[1]}/moving-small-0.1", "large": f"{TASKS[1]}/moving-huge-0.1"}
HITS = (Outcome.HIT_MOVING, Outcome.HIT_STILL, Outcome.HIT_AT_REST)
PICTURE = (1200, 900)  # of a strip [pixels]
AFTER = 0.1  # time that a strip of a contact goes on for [s]
HEAD = ("example", "method", "world", "outcome", "reason")


@dataclass(frozen=True)
class Kind:
    """A kind of failure of the paper's figure.

    Attributes:
        outcomes: What counts as it.
        labels: Methods that may show it, the paper's first.
    """

    outcomes: tuple[Outcome, ...]
    labels: tuple[str, ...]


KINDS = {
    "collision": Kind((Outcome.HIT_MOVING, Outcome.HIT_STILL), ("il", UNGUIDED)),
    "stuck": Kind((Outcome.STUCK, Outcome.TIMEOUT), ("drrt", "rrtconnect", "damon", FAITHFUL)),
    "misaligned": Kind((Outcome.MISALIGNED,), ("damon", "il", FAITHFUL)),
}


def in_order(runs: Iterable[Run]) -> list[Run]:
    """Return runs in the order of the test split: the first worlds of all levels, then the second ones."""
    levels = list(MOVING)
    return sorted(runs, key=lambda run: (run["seed"], levels.index(run["experiment"])))


def first_failure(runs: Sequence[Run], kind: Kind) -> Run | None:
    """Return the first run that fails so: of the first method that has one, the first world of the test split."""
    for label in kind.labels:
        for run in in_order(run for run in runs if run["label"] == label):
            if run.get("outcome") in kind.outcomes:
                return run
    return None


def failures(args: Namespace) -> Made:
    """Return one failure of each kind."""
    labels = list(dict.fromkeys(label for kind in KINDS.values() for label in kind.labels))
    _, results = loop_runs(args, labels=labels)
    found = {name: first_failure(results.runs, kind) for name, kind in KINDS.items()}
    notes, commits = of_runs(results, planned=False)
    rule = "; ".join(f"{name}: {', '.join(map(str, kind.outcomes))} by {', else '.join(kind.labels)}"
                     for name, kind in KINDS.items())  # fmt: skip
    notes.append(("Rule", f"the first world of the test split that fails so, of the first method that has one: {rule}"))
    return shown({name: run for name, run in found.items()}, "Failures", notes, commits)


def strips(args: Namespace) -> Made:
    """Return a run with and one without guidance, by a small and by a large cube."""
    levels, labels = list(STRIP_LEVELS.values()), (FAITHFUL, UNGUIDED)
    _, results = loop_runs(args, levels, labels)
    notes, commits = of_runs(results, planned=False)
    found: dict[str, Run | None] = {}
    for size, level in STRIP_LEVELS.items():
        of = {label: {r["seed"]: r for r in results.runs if (r["experiment"], r["label"]) == (level, label)}
              for label in labels}  # fmt: skip
        chosen, count = telling(of, contact=size == "large")
        wanted = "the unguided run touches something" if size == "large" else "so does the unguided run"
        notes.append((f"Rule, {size}", f"the first test world in which the guided run reaches the goal and {wanted} "
                                       f"({count} of {len(of[FAITHFUL])}), else the first one"))  # fmt: skip
        found |= {f"{size} cube, guided": of[FAITHFUL][chosen], f"{size} cube, unguided": of[UNGUIDED][chosen]}
    return shown(found, "With and without guidance", notes, commits)


def telling(of: dict[str, dict[int, Run]], *, contact: bool) -> tuple[int, int]:
    """Return the seed of the first world that shows what guidance does, else the first, and how many do.

    Args:
        of: Runs by seed, of the guided and of the unguided method.
        contact: Whether the unguided run is to touch something, or else to reach the goal.
    """
    wanted: Callable[[Run], bool] = (lambda r: r.get("outcome") in HITS) if contact else (lambda r: bool(r["solved"]))
    seeds = [seed for seed in sorted(of[FAITHFUL]) if of[FAITHFUL][seed]["solved"] and wanted(of[UNGUIDED][seed])]
    return (seeds or sorted(of[FAITHFUL]))[0], len(seeds)


def shown(found: dict[str, Run | None], title: str, notes: list[tuple[str, Any]], commits: str) -> Made:
    """Return some runs as a figure: they are made again, bit for bit, and drawn by the project's renderer."""
    there = {name: run for name, run in found.items() if run is not None}
    columns = 2 if len(there) == 4 else max(len(there), 1)
    rows = -(-max(len(there), 1) // columns)
    picture = blank(5.2 * columns, 2.9 * rows)
    axes = np.atleast_1d(picture.subplots(rows, columns)).ravel()
    data, lines = {}, []
    for axis in axes:
        axis.set_axis_off()
    for axis, (name, run) in zip(axes, there.items(), strict=False):
        result = loop_result(run["problem"], run["planner"], run["seed"], LIMIT, run["params"])
        axis.imshow(strip(result))
        axis.set_title(f"{name}: {run['label']}, {run['problem']}, {result.outcome}", fontsize=8)
        data[name] = {"method": run["label"], "world": run["problem"], "outcome": str(result.outcome),
                      "reason": result.reason}  # fmt: skip
        lines.append([name, run["label"], run["problem"], str(result.outcome), result.reason or "-"])
    for name in found.keys() - there.keys():
        data[name] = None
        lines.append([name, "-", "-", "none found", "-"])
    return Made(data, [Table(title, HEAD, lines)], notes, picture if there else None, commits)


def strip(result: RunResult) -> np.ndarray:
    """Return an image of moments of a run in reading order, to its end or to its contact."""
    from matplotlib.image import imread

    from apex_ompl.viz.render import render

    report = judge(robot(), result.problem, result.trajectory)
    contacts = [hit.time for hit in (report.contact, report.still_contact) if hit is not None]
    if contacts:
        result = replace(result, trajectory=until(result.trajectory, min(contacts) + AFTER))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "strip.png"
        render(result, file, PICTURE)
        return np.asarray(imread(file))


def until(motion: Trajectory, time: float) -> Trajectory:
    """Return the beginning of a motion, up to a time [s]."""
    time = min(time, motion.duration)
    before = motion.times < time - 1e-9
    knots = (motion.positions, motion.velocities, motion.accelerations)
    q, v, a = (np.concatenate([values[before], motion(time, k)[None]]) for k, values in enumerate(knots))
    return Trajectory(np.append(motion.times[before], time), q, v, a, motion.joint_names)
