"""Plans among obstacles that move: the frozen levels with a moving cube, planned offline in time.

The cube and its motion are known. Each motion is checked again by ``check_timed_path``, which knows nothing of how it
was made: samples 4 ms apart, joined by straight lines, among cubes that are 2.5 mm larger than what they sweep.
Durations are compared with those of the frozen witnesses, which take a quarter of the velocity limits, and of the
straight line from start to goal among no obstacles at all of them. Each run is stored in benchmarks/runs/moving when it
ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.moving [-n 20] [--jobs 1] [--store FOLDER] [--report] [--split test]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.evaluation import Results, Row, Workers, bench, runs
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.moving.timed_proof import check_timed_path
from apex_ompl.planning.among_dynamic_obstacles import RETIMED, SPACE_TIME, STAGES
from apex_ompl.problems.alignment import SIZES, SPEEDS, VELOCITY_SCALE
from apex_ompl.problems.suite_robot import robot
from apex_ompl.timing import time_path
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record

DEPENDS = ("@benchmark", "apex_ompl/moving", "apex_ompl/timing")
FOLDER = record.RESULTS.parent / "runs" / "moving"
TIMEOUT, SPACING = 10.0, 0.004  # [s]
LEVELS = [
    f"{suite}/moving-{size}-{speed}" for suite in ("vertical", "horizontal") for size in SIZES for speed in SPEEDS
]


def _run(job: Job, stages: Sequence[str]) -> Run:
    """Return the columns of a run, with the check of its motion and durations to compare it with [s]."""
    planning, experiment, result = runs.in_time(replace(job, runner=""), stages)
    found = runs.columns(planning, experiment, result)
    motion, problem = result.trajectory, problems.load(job.problem)
    if not found["solved"] or motion is None:
        return found
    times = np.linspace(0.0, motion.duration, int(np.ceil(motion.duration / SPACING)) + 1)
    check = check_timed_path(robot(), problem, motion(times), times)
    names, limits = robot().joint_names, robot().limits
    line = np.stack([problem.start_state(names), problem.goal_states(names)[0]])
    witness = problems.witness(job.problem).times
    assert witness is not None
    return {
        **found, "duration": motion.duration, "fault": check.reason, "use": max(motion.use(limits).values()),
        "line_duration": time_path(line, limits, names).trajectory.duration,
        "witness_duration": float(witness[-1]), "moment": result.times["total"],
    }  # fmt: skip


def path_alone(job: Job) -> Run:
    """Return a run in which the motion of the path is not changed."""
    return _run(job, ())


def retimed(job: Job) -> Run:
    """Return a run in which the motion of the path is retimed only."""
    return _run(job, (RETIMED,))


def space_time(job: Job) -> Run:
    """Return a run in which motions are optimized in space and time only."""
    return _run(job, (SPACE_TIME,))


def all_stages(job: Job) -> Run:
    """Return a run with all stages."""
    return _run(job, STAGES)


ROWS = {
    "all stages": all_stages,
    "space-time only": space_time,
    "retiming only": retimed,
    "the path's own motion": path_alone,
}
PAIRS = ("time_s", "call_s", "duration_s", "of_witness", "of_line")  # of percentiles


def summary(some: Sequence[Run]) -> dict[str, Any]:
    """Return shares and percentiles of some runs; runs without a motion have infinite times."""
    good = [run for run in some if run["solved"]]
    ratios = [[run["duration"] / run[name] for run in good] for name in ("witness_duration", "line_duration")]
    return {
        "n": len(some), "solved": len(good) / len(some), "contacts": sum(bool(run["fault"]) for run in good),
        "over_limits": sum(run["use"] > 1.0 + 1e-9 for run in good),
        "time_s": [record.reached([run["total"] if run["solved"] else np.inf for run in some], p) for p in (50, 95)],
        "call_s": record.percentiles([run["moment"] for run in good], 50, 95) if good else [None, None],
        "duration_s": record.percentiles([run["duration"] for run in good], 50, 95) if good else [None, None],
        "of_witness": record.percentiles(ratios[0], 50, 95) if good else [None, None],
        "of_line": record.percentiles(ratios[1], 50, 95) if good else [None, None],
    }  # fmt: skip


def table(rows: dict[str, dict[str, Any]]) -> str:
    """Return the Markdown table of rows."""
    head = ["", "N", "solved", "contacts", "time s p50", "p95", "call s p50", "p95", "motion s p50", "p95",
            "of the witness's p50", "p95", "of the line's p50", "p95"]  # fmt: skip
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for name, s in rows.items():
        pairs = ["-" if v is None else f"{v:.3g}" for key in PAIRS for v in s[key]]
        lines.append([name, s["n"], f"{100 * s['solved']:.1f} %", s["contacts"], *pairs])
    return "\n".join(record.row(line) for line in lines)


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=20, of="problems of each level", jobs=1)
    parser.add_argument("--split", default="test", choices=("test", "validation"))
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    wanted = [
        Row(name, "apex", runner=f"benchmarks.planners.moving:{function.__name__}") for name, function in ROWS.items()
    ]
    if not args.report:
        bench(
            LEVELS, wanted, args.store, runs=args.n, timeout=TIMEOUT, workers=Workers(args.jobs), split=args.split,
            provenance=record.session(),
        )  # fmt: skip
    results = Results.load(args.store)
    made = [
        run for run in results.runs
        if run["experiment"] in LEVELS and run["seed"] < args.n and run["status"] != runs.NO_PROBLEM
    ]  # fmt: skip
    by_row = {name: summary([run for run in made if run["label"] == name]) for name in ROWS}
    first = next(iter(ROWS))
    by_level = {level: [r for r in made if r["experiment"] == level and r["label"] == first] for level in LEVELS}
    levels = {level: summary(some) for level, some in by_level.items() if some}
    text = f"{table(by_row)}\n\nBy level, {first}:\n\n{table(levels)}"
    data = {"rows": by_row, "levels": levels, "witness_share_of_limits": VELOCITY_SCALE}
    record.write(
        "moving", data, text, split=args.split, timeout=TIMEOUT, **record.made_with(replace(results, runs=made))
    )


if __name__ == "__main__":
    run_script(main)
