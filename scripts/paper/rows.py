"""Rows of the paper's figures: planners in scenes that stand still, replanners among cubes that move.

A row whose planner, or replanner, is not in this installation is left out with a printed line.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

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
ONE, ONE_SAMPLE = ", one sample", "paper.realism:one_sample"
PATIENCE = 60.0
"""Time limit of ``apex-paper`` [s]: it samples until a path is valid, each in a second or two."""
ALONE = {**PAPER, "model": "apex", "scaling": "clean", "first": 8, "second": 8, "third": 16}

PLANNERS = (
    Row(OURS, "apex"),
    Row(FAITHFUL, "apex", {**PAPER, "guidance": True}, timeout=PATIENCE),
    Row(UNGUIDED, "apex", PAPER, timeout=PATIENCE),
    Row(f"{FAITHFUL}{ONE}", "apex", {"gamma": EQUATION_7.gamma}, runner=ONE_SAMPLE),
    Row(f"{UNGUIDED}{ONE}", "apex", {"gamma": 0.0}, runner=ONE_SAMPLE),
    Row("apex's model alone", "apex", {**ALONE, "guidance": True}),
    Row("apex's model alone, unguided", "apex", ALONE),
    Row("rrt", "rrt", TUNED["rrt"]),
    Row("rrtconnect", "rrtconnect", TUNED["rrtconnect"]),
    Row("rrtconnect, OMPL's range", "rrtconnect"),
    Row("drrt", "drrt"),
    Row("gpmp", "gpmp"),
    Row("gpmp2", "gpmp2"),
    Row("il", "il", {"repair": False}),
    Row("il, repaired", "il", {"repair": True}),
    Row("il-paper", "il-paper"),
    Row("damon", "damon", {"model": "damon-8", "nodes": "decoded"}),
    Row("damon, 2 dimensions", "damon", {"model": "damon-2", "nodes": "decoded"}),
    Row("damon, 4 dimensions", "damon", {"model": "damon-4", "nodes": "decoded"}),
    Row("damon, stored", "damon", {"model": "damon-8", "nodes": "stored"}),
)
"""Planners, as the benchmark runs them. ``apex's model alone`` has neither trees nor repair, as ``apex-paper``."""

RUNNER = "paper.moving:loop_run"
PACE = 0.25  # share of the velocity limits at which the cubes were placed to meet the robot
SWEPT = tuple(level for level, size in MOVING.items() if size == "large")  # levels of the sweeps


def in_loop(label: str, method: str, levels: tuple[str, ...] = (), **changed: float | str) -> Row:
    """Return the row of a replanner, with parameters of the loop that differ from the defaults."""
    return Row(label, method, {"speed": PACE, **changed}, levels=levels, runner=RUNNER)


METHODS = (
    in_loop(FAITHFUL, "apex-paper"),
    in_loop(UNGUIDED, "apex-paper-unguided"),
    in_loop(f"{FAITHFUL}, ideal", "apex-paper", latency=0.0),
    in_loop(f"{UNGUIDED}, ideal", "apex-paper-unguided", latency=0.0),
    in_loop(OURS, "apex"),
    in_loop(f"{OURS}, ideal", "apex", latency=0.0),
    in_loop("no-network", "no-network"),
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

COLORS = {
    OURS: "#0b6e4f", "apex, unguided": "#9fc8b7", FAITHFUL: "#3d5a80", UNGUIDED: "#98b6d8",
    "apex's model alone": "#7a5195", "apex's model alone, unguided": "#c9a6d6", "rrt": "#c8553d",
    "rrtconnect": "#e0a458", "drrt": "#a3443b", "gpmp": "#6a994e", "gpmp2": "#386641", "il": "#bc6c25",
    "il, repaired": "#dda15e", "il-paper": "#7f5539", "damon": "#5f0f40",
    "damon, stored": "#9a348e", "no-network": "#4f9d7f", "stop-and-wait": "#8d99ae", "blind": "#555555",
}  # fmt: skip


def color(label: str) -> str:
    """Return the color of a row in pictures; variants have that of their row."""
    known = [name for name in COLORS if label == name or label.startswith(f"{name}, ")]
    return COLORS[max(known, key=len)] if known else "#999999"


def installed(rows: Sequence[Row], known: Collection[str]) -> tuple[Row, ...]:
    """Return the rows whose planner is among those known; print which are left out."""
    for row in rows:
        if row.planner not in known:
            print(f"{row.label}: left out, this installation has no {row.planner}", flush=True)
    return tuple(row for row in rows if row.planner in known)
