"""Planners under constraints: trays in both hands, level trays and upright cups, beside their rivals, in one second.

Problems: the levels ``tray``, ``level`` and ``cups`` of the suites (test split), and of ``unseen`` (validation, without
the first ones, on which planners are tuned). Rows: apex; apex without network; line + LM, which is the straight line
and its optimization under constraints; cbirrt, which is its trees alone; OMPL's constrained spaces with RRTConnect;
sscbirrt and RoboPlan, where they are installed. Every rival has the same problems and time limit. All but RoboPlan use
this project's collision checker, and its compiled projection.

A run is solved where the path passed the row's own check and an independent one: constraints and collisions at states
twenty times as dense as the search's (:mod:`benchmarks.planners.constrained_check`), of apex along the timed motion,
too. Times of rivals leave out that check.
Each run is stored in benchmarks/runs/constrained when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.constrained [SUITE[/LEVEL] ...] [-n 17] [--unseen 67] [--rows NAME ...] [--jobs 1]
       python -m benchmarks.planners.constrained --tune atlas [-n 4]    (on validation problems)
"""

from __future__ import annotations

import importlib.util
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.api import plan
from apex_ompl.errors import UnknownNameError
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.problems.catalogue import CONSTRAINED, SPLITS, VALIDATION
from apex_ompl.result import FIRST
from apex_ompl.robot import load_robot
from apex_ompl.util.clocks import timed
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.planners.constrained_check import DENSE, dense_check, problem_of

DEPENDS = (
    "@benchmark", "apex_ompl/constraints", "benchmarks/planners/constrained_check.py",
    "benchmarks/planners/constrained_ompl.py", "benchmarks/planners/constrained_sscbirrt.py",
    "benchmarks/planners/constrained_roboplan.py", "benchmarks/planners/peers.py",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs" / "constrained"
TIMEOUT = 1.0  # [s]
TUNED_ON = 8  # validation problems of a level
OWN, OMPL, SSCBIRRT, ROBOPLAN = (
    f"benchmarks.planners.{name}"
    for name in (
        "constrained:plan_with_apex", "constrained_ompl:plan_with_ompl", "constrained_sscbirrt:plan_with_sscbirrt",
        "constrained_roboplan:plan_with_roboplan",
    )
)  # fmt: skip
PACKAGES = {SSCBIRRT: "sscbirrt", ROBOPLAN: "roboplan"}
NO_PROPOSALS = {"model": "none", "first": 0, "second": 0, "third": 0, "resample": 0}
BASE = "cbirrt"
ROWS = (
    Row("apex", "apex", runner=OWN),
    Row("apex without network", "apex", {"model": "none"}, runner=OWN),
    Row("line + LM", "apex", {**NO_PROPOSALS, "sprint": 0, "fallback": False}, runner=OWN),
    Row(BASE, "apex", {**NO_PROPOSALS, "line": False}, runner=OWN),
    Row("ompl projected", "projected", runner=OMPL),
    Row("ompl atlas", "atlas", runner=OMPL),
    Row("ompl tangent bundle", "tangent_bundle", runner=OMPL),
    Row("sscbirrt", "sscbirrt", runner=SSCBIRRT),
    Row("roboplan", "roboplan", runner=ROBOPLAN),
)
GRIDS: Mapping[str, Mapping[str, Sequence[Any]]] = {
    "ompl projected": {"range": (None, 0.3, 1.0), "delta": (0.05, 0.2), "stretch": (2.0, 4.0)},
    "ompl atlas": {"delta": (0.05, 0.2), "rho": (None, 0.5), "exploration": (None, 0.5), "range": (None, 1.0)},
    "ompl tangent bundle": {"delta": (0.05, 0.2), "rho": (None, 0.5), "exploration": (None, 0.5), "range": (None, 1.0)},
    "sscbirrt": {"step_size": (0.1, 0.3), "edge_resolution": (0.03, 0.05), "extend_steps": (None, 3)},
    "roboplan": {"max_connection_distance": (0.5, 3.0), "path_step_size": (0.05, 0.1)},
}
"""Row -> the parameters that are tried on validation problems."""


def plan_with_apex(job: Job) -> Run:
    """Return the columns of a run of ``apex_ompl.plan``, with the dense checks of its path and its motion."""
    problem = problem_of(job)
    result = plan(problem, job.planner, timeout=job.timeout, seed=job.seed, params=dict(job.params))
    times = dict(result.times)
    found: Run = {
        "solved": bool(result), "status": str(result.status), "reason": result.reason, "by": result.solved_by,
        "first": None, "total": times["total"] - times.get("setup", 0.0), "times": times, "length": None,
        "failed_check": False, "violation": None, "duration": None,
    }  # fmt: skip
    if not result or result.path is None or result.trajectory is None:
        return found
    robot = load_robot(problem.robot)
    with timed(times, "check"):
        spacing = DENSE / float(robot.limits.velocity.max())
        motion = result.trajectory.sample(spacing).position
        checks = [dense_check(robot, problem, states) for states in (result.path.states, motion)]
    passed = all(checks)
    first = times.get(FIRST, times["solve"])
    return found | {
        "solved": passed, "first": first if passed else None, "length": result.length, "failed_check": not passed,
        "violation": max(check.violation for check in checks), "duration": result.trajectory.duration,
        "reason": "" if passed else "the path or the motion failed the dense check",
    }  # fmt: skip


def levels_of(wanted: Sequence[str]) -> list[str]:
    """Return the levels with constraints, or those of them that are wanted: SUITE or SUITE/LEVEL.

    Raises:
        UnknownNameError: No such suite or level.
    """
    known = [f"{suite}/{level}" for suite, levels in CONSTRAINED.items() for level in levels]
    for name in wanted:
        if name not in known and name not in CONSTRAINED:
            raise UnknownNameError("suite or level with constraints", name, known)
    return [level for level in known if not wanted or level in wanted or level.partition("/")[0] in wanted]


def problems_of(level: str, count: int, *, tune: bool) -> list[str]:
    """Return the ids of the problems of a level: of the test split, or of validation for ``unseen`` and to tune."""
    if tune:
        return [f"{level}/{seed}" for seed in SPLITS["validation"][: min(count, TUNED_ON)]]
    seeds = SPLITS["test"]
    if level.partition("/")[0] in VALIDATION:
        seeds = SPLITS["validation"][TUNED_ON:]
    return [f"{level}/{seed}" for seed in seeds[:count]]


def grid(name: str) -> list[Row]:
    """Return rows with all combinations of the parameters that are tried of a row."""
    row = next(row for row in ROWS if row.label == name)
    values = GRIDS[name]
    found = []
    for chosen in itertools.product(*values.values()):
        params = {key: value for key, value in zip(values, chosen, strict=True) if value is not None}
        found.append(Row.of(row.planner, {**row.params, **params}, runner=row.runner))
    return found


def group_of(problem: str) -> str:
    """Return the group of a problem: its level over all suites, of ``unseen`` apart."""
    suite, level, _ = problem.split("/")
    return f"unseen, {level}" if suite in VALIDATION else f"suites, {level}"


def summary(runs: Sequence[Run], base: Mapping[str, float]) -> dict[str, Any]:
    """Return the statistics of the runs of a row; lengths are compared with ``base``, by problem."""
    found = Statistics("", "", runs)
    pairs = [run["length"] / base[run["problem"]] for run in found.solved if base.get(run["problem"])]
    violations = [run["violation"] for run in runs if run.get("violation") is not None and run["solved"]]
    durations = [run["duration"] for run in found.solved if run.get("duration") is not None]
    return {
        "n": len(runs), "solved": len(found.solved) / len(runs),
        "interval": share_interval(len(found.solved), len(runs)),
        "first_s": [record.reached(found.times("first"), p) for p in (50, 95)],
        "end_s": record.reached(found.times("total"), 50), "failed_check": sum(run["failed_check"] for run in runs),
        "violation": max(violations, default=None), "length": found.median("length"),
        "length_ratio": math.exp(float(np.mean(np.log(pairs)))) if pairs else None, "pairs": len(pairs),
        "duration_s": float(np.median(durations)) if durations else None,
    }  # fmt: skip


def tabulate(results: Results, rows: Sequence[Row]) -> tuple[dict[str, Any], str]:
    """Return the statistics of each row on groups of problems, and a Markdown table of them."""
    runs = [{"failed_check": False, **run} for run in results.runs if run["status"] != NO_PROBLEM]
    base = {run["problem"]: run["length"] for run in runs if run["label"] == BASE and run["solved"]}
    groups = dict.fromkeys(group_of(run["problem"]) for run in sorted(runs, key=lambda run: group_of(run["problem"])))
    head = ["problems", "row", "N", "solved (95 %, Wilson)", "failed the dense check", "first path ms p50", "p95"]
    head += ["end ms p50", "violation / tolerance", f"length / {BASE}'s", "duration s"]
    lines = [record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 2)])]
    found: dict[str, Any] = {}
    for group in (*groups, "suites", "unseen"):
        for row in rows:
            mine = [r for r in runs if r["label"] == row.label and group_of(r["problem"]).startswith(group)]
            if not mine:
                continue
            f = found[f"{group}, {row.label}"] = summary(mine, base)
            low, high = f["interval"]
            times = ["-" if v is None else f"{1e3 * v:.0f}" for v in (*f["first_s"], f["end_s"])]
            ratio = "-" if f["length_ratio"] is None else f"{f['length_ratio']:.2f} ({f['pairs']})"
            violation, duration = (
                "-" if f[key] is None else f"{f[key]:.2f}" for key in ("violation", "duration_s")
            )  # fmt: skip
            share = f"{f['solved']:.3f} ({low:.3f} to {high:.3f})"
            lines.append(
                record.row([group, row.label, f["n"], share, f["failed_check"], *times, violation, ratio, duration])
            )
    return found, "\n".join(lines)


def available(rows: Sequence[Row]) -> list[Row]:
    """Return the rows whose packages are installed; name the others."""
    missing = [row for row in rows if row.runner in PACKAGES and not importlib.util.find_spec(PACKAGES[row.runner])]
    for row in missing:
        print(f"no {PACKAGES[row.runner]}: {row.label} is left out")
    return [row for row in rows if row not in missing]


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=17, jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument(
        "--unseen", type=one_or_more, default=67, help="problems of a level of unseen (default: %(default)s)"
    )
    names = [row.label for row in ROWS]
    parser.add_argument("--rows", nargs="*", choices=names, default=names, metavar="NAME", help="(default: all)")
    parser.add_argument("--tune", choices=GRIDS, metavar="NAME", help="try the grid of a row on validation problems")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    args = parser.parse_args()
    wanted = grid(args.tune) if args.tune else [row for row in ROWS if row.label in args.rows]
    rows, levels = available(wanted), levels_of(args.levels)
    ids = [
        problem
        for level in levels
        for problem in problems_of(level, args.unseen if level.startswith("unseen/") else args.n, tune=bool(args.tune))
    ]  # fmt: skip
    store = args.store.with_name(f"{args.store.name}_tuning") if args.tune else args.store
    split = "validation" if args.tune else "test"
    results = bench(
        ids, rows, store, runs=1, timeout=TIMEOUT, split=split, workers=Workers(args.jobs),
        provenance=record.session(),
    )  # fmt: skip
    labels, chosen = {row.label for row in rows}, set(ids)
    results = replace(results, runs=[r for r in results.runs if r["problem"] in chosen and r["label"] in labels])
    found, table = tabulate(results, rows)
    name = f"constrained_tuning_{args.tune.replace(' ', '_')}" if args.tune else "constrained"
    about = {"limit": f"{TIMEOUT:g} s", "seeds": "0", **record.made_with(results)}
    record.write(name, {"groups": found}, table, split=f"{split}, of unseen validation", **about)


if __name__ == "__main__":
    run_script(main)
