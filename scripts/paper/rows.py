"""Rows of the paper's figures, and how many runs decide them: planners in static scenes, replanners among moving cubes.

A row whose planner, replanner or checkpoint is missing in this installation is left out with a printed line. The
option ``-n`` of the script is the largest number of runs on a level; the rows have their own below.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from apex_ompl.evaluation import Row
from apex_ompl.evaluation.rows import PAPER
from apex_ompl.model.guidance import EQUATION_7
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.problems.alignment import SIZES, SPEEDS

TASKS = ("vertical", "horizontal")
BOTH = "both"
STATIC = {f"{task}/{size}": edge for task in TASKS for size, edge in {"free": 0.0, **SIZES}.items()}
"""Static levels, with the edge of their cubes [m]."""
MOVING = {f"{task}/moving-{size}-{speed}": size for task in TASKS for size in SIZES for speed in SPEEDS}
"""Levels with a moving cube, with the size of it."""
FAITHFUL, UNGUIDED, OURS = "apex-paper", "apex-paper, unguided", "apex"
ONE = ", one sample"
PATIENCE = 60.0
"""Time limit of ``apex-paper`` [s]: it samples until a path is valid, each in a second or two."""
ALONE = {**PAPER, "model": "apex", "scaling": "clean", "first": 8, "second": 8, "third": 16}
NO_NETWORK, MOVED_NO_NETWORK = f"{OURS}, no network", "no-network"
SIZED = "apex-paper-sizes"
"""Checkpoint of the same network with the obstacles' sizes, as ``scripts/configs/apex-paper-sizes.yaml`` trains it."""
TRAINED = Path(__file__).resolve().parents[2] / "benchmarks" / "baselines"

FEW, SOME, MANY = 5, 20, 100
"""Runs on a static level (task and size): of what samples for a minute, of the others, and of the rows that decide."""
CENTRAL = 150
"""Runs on the largest static levels, of the central claim: 300 on both tasks."""
PASSING, CENTRAL_PASSING = 10, 50
"""Runs on a level of cubes that pass on (task, size and one of three speeds): 60 of a size, 300 of the largest."""
IMPOSED, CENTRAL_IMPOSED = 50, 360
"""Runs on a task and size of cubes that are brought in: in 42 % of the largest there is room for a cube."""
TIMED, ONE_SAMPLE = "paper.motions:timed", "paper.motions:one_sample"


def planner(label: str, name: str, params: dict[str, object] | None = None, runs: int = SOME) -> Row:
    """Return the row of a planner by OMPL's Benchmark, whose paths are timed as well."""
    return Row(label, name, params or {}, runs=runs, runner=TIMED)


def sampled(model: str, *, guided: bool) -> Row:
    """Return the row of one sample of a model for each problem."""
    label = f"{model}{'' if guided else ', unguided'}{ONE}"
    gamma = EQUATION_7.gamma if guided else 0.0
    return Row(label, "apex", {"model": model, "gamma": gamma}, runs=MANY, runner=ONE_SAMPLE)


PLANNERS = (
    planner(OURS, "apex", runs=MANY),
    planner(NO_NETWORK, "apex", {"model": "none"}, MANY),
    sampled(FAITHFUL, guided=True),
    sampled(FAITHFUL, guided=False),
    sampled(SIZED, guided=True),
    sampled(SIZED, guided=False),
    replace(planner(FAITHFUL, "apex", {**PAPER, "guidance": True}, FEW), timeout=PATIENCE),
    replace(planner(UNGUIDED, "apex", PAPER, FEW), timeout=PATIENCE),
    planner("apex's model alone", "apex", {**ALONE, "guidance": True}),
    planner("apex's model alone, unguided", "apex", ALONE),
    planner("rrt", "rrt", TUNED["rrt"]),
    planner("rrtconnect", "rrtconnect", TUNED["rrtconnect"]),
    planner("rrtconnect, OMPL's range", "rrtconnect"),
    planner("drrt", "drrt"),
    planner("gpmp", "gpmp"),
    planner("gpmp2", "gpmp2"),
    planner("il", "il", {"repair": False}),
    planner("il, repaired", "il", {"repair": True}),
    planner("il-paper", "il-paper"),
    planner("damon", "damon", {"model": "damon-8", "nodes": "decoded"}),
    planner("damon, 2 dimensions", "damon", {"model": "damon-2", "nodes": "decoded"}),
    planner("damon, 4 dimensions", "damon", {"model": "damon-4", "nodes": "decoded"}),
    planner("damon, stored", "damon", {"model": "damon-8", "nodes": "stored"}),
)
"""Planners in static scenes, those over size first. ``apex's model alone`` has neither trees nor repair."""
OVER_SIZE = 10
"""The first so many rows are those of the figure over size: apex, and each model guided and not."""
LARGEST = tuple(level for level in STATIC if level.endswith("/huge"))
CLAIMED = tuple(replace(row, runs=CENTRAL) for row in PLANNERS if row.runner == ONE_SAMPLE)
"""Rows of the central claim, on ``LARGEST``."""

RUNNER = "paper.moving:loop_run"
PACE = 0.25  # share of the velocity limits at which the cubes were placed to meet the robot
SWEPT = tuple(level for level, size in MOVING.items() if size == "large")  # levels of the sweeps


def in_loop(label: str, method: str, levels: tuple[str, ...] = (), **changed: float | str) -> Row:
    """Return the row of a replanner, with parameters of the loop that differ from the defaults."""
    return Row(label, method, {"speed": PACE, **changed}, levels=levels, runner=RUNNER, runs=PASSING)


METHODS = (
    in_loop(FAITHFUL, "apex-paper"),
    in_loop(UNGUIDED, "apex-paper-unguided"),
    in_loop(f"{FAITHFUL}, ideal", "apex-paper", latency=0.0),
    in_loop(f"{UNGUIDED}, ideal", "apex-paper-unguided", latency=0.0),
    in_loop(OURS, "apex"),
    in_loop(f"{OURS}, ideal", "apex", latency=0.0),
    in_loop(MOVED_NO_NETWORK, "no-network"),
    in_loop("rrtconnect", "rrtconnect"),
    in_loop("drrt", "drrt"),
    in_loop("gpmp", "gpmp"),
    in_loop("gpmp2", "gpmp2"),
    in_loop("il", "il"),
    in_loop("il-paper", "il-paper"),
    in_loop("damon", "damon"),
    in_loop("stop-and-wait", "stop-and-wait"),
    in_loop("blind", "blind"),
)
"""Replanners on all moving levels; ``ideal`` answers take no time."""

SWEEPS = (
    *(in_loop(f"{FAITHFUL}, trigger {d:g} m", "apex-paper", SWEPT, trigger=d) for d in (0.02, 0.1)),
    in_loop(f"{FAITHFUL}, full speed", "apex-paper", SWEPT, speed=1.0),
    in_loop(f"{OURS}, full speed", "apex", SWEPT, speed=1.0),
    in_loop(f"{OURS}, obstacles taken to stand", "apex", SWEPT, prediction="still"),
    in_loop(f"{OURS}, obstacles known", "apex", SWEPT, prediction="truth"),
)
"""One choice changed at a time, on the levels with a large cube."""

CENTRAL_LABELS = (FAITHFUL, UNGUIDED, OURS, MOVED_NO_NETWORK)
LARGEST_MOVING = tuple(level for level, size in MOVING.items() if size == "huge")
CLAIMED_MOVING = tuple(replace(row, runs=CENTRAL_PASSING) for row in METHODS if row.label in CENTRAL_LABELS)
"""Rows of the central claim among cubes that pass on, on ``LARGEST_MOVING``."""

BROUGHT_IN = (*CENTRAL_LABELS, "rrtconnect", "stop-and-wait", "blind")
FREE = tuple(f"{task}/free" for task in TASKS)
"""Levels of the worlds in which a cube is brought in: their problems have no obstacles of their own."""


def brought(size: str, runs: int, labels: Sequence[str]) -> tuple[Row, ...]:
    """Return the rows of replanners in worlds of the kind ``imposed`` with a size of cubes, on ``FREE``."""
    rows = [row for row in METHODS if row.label in labels]
    return tuple(replace(in_loop(f"{row.label}, {size}", row.planner, size=size), runs=runs) for row in rows)


COLORS = {
    OURS: "#0b6e4f", "apex, unguided": "#9fc8b7", FAITHFUL: "#3d5a80", UNGUIDED: "#98b6d8",
    "apex's model alone": "#7a5195", "apex's model alone, unguided": "#c9a6d6", "rrt": "#c8553d",
    "rrtconnect": "#e0a458", "drrt": "#a3443b", "gpmp": "#6a994e", "gpmp2": "#386641", "il": "#bc6c25",
    "il, repaired": "#dda15e", SIZED: "#2a9d8f", "il-paper": "#7f5539", "damon": "#5f0f40",
    "damon, stored": "#9a348e", "no-network": "#4f9d7f", "stop-and-wait": "#8d99ae", "blind": "#555555",
}  # fmt: skip


def color(label: str) -> str:
    """Return the color of a row in pictures; variants have that of their row."""
    known = [name for name in COLORS if label == name or label.startswith(f"{name}, ")]
    return COLORS[max(known, key=len)] if known else "#999999"


def checkpoint(model: str) -> Path | None:
    """Return the folder of a model that does not ship with the package, where it was trained."""
    folder = TRAINED / model
    return folder if folder.is_dir() else None


def installed(rows: Sequence[Row], known: Collection[str]) -> tuple[Row, ...]:
    """Return the rows whose planner is among those known and whose model is there; print which are left out."""
    there = []
    for row in rows:
        if row.planner not in known:
            print(f"{row.label}: left out, this installation has no {row.planner}", flush=True)
        elif untrained(row):
            print(f"{row.label}: left out, {SIZED} is not trained", flush=True)
        else:
            there.append(row)
    return tuple(there)


def untrained(row: Row) -> bool:
    """Whether the model of a row was never trained."""
    return row.params.get("model") == SIZED and checkpoint(SIZED) is None
