"""Planners under constraints: trays in both hands, level trays and upright cups, beside their rivals, in one second.

Problems: the levels ``tray``, ``level`` and ``cups`` of the suites (test split), and of ``unseen`` (validation, without
the first ones, on which rivals are tuned). Rows: apex; apex without network; line + LM, which is the straight line and
its optimization under constraints; cbirrt, this project's trees with shortcuts and polish; OMPL's constrained spaces
with RRTConnect; sscbirrt and RoboPlan, where they are installed. Rivals have the same problems and time limit, and
their tuned parameters. All but RoboPlan use this project's collision checker and
its compiled projection.

A run is solved where a path came within the limit, and passed the row's own check and an independent one: constraints
by Pinocchio and collisions at states twenty times as dense as the search's
(:mod:`benchmarks.planners.constrained_check`), of apex and cbirrt along the timed motion, too; a path that fails the
latter is a fault. ``call`` is the CPU time of the whole call of ``plan``, motion included, for apex, and of search and
simplification for rivals. Percentiles are over all problems: first-path times of unsolved ones are infinite.
``direct`` is the duration of the motion from rest to rest with each joint within its limits, obstacles and constraints
ignored, ``best`` the least of all rows.
Each run is stored in benchmarks/runs/constrained when it ends; the command resumes where it was stopped.

``--motions`` plans each problem with some more seeds, and checks the motions alone.
``--tune`` tries candidates of rows on validation problems of every second level, by CPU time: all on the first of each
level, the best two on the second, too. The score is the mean time to the first path, an unsolved one counts as twice
the limit; for rows that shorten their paths, times the mean of the length over the shortest of all candidates, where an
unsolved one counts as 2.

Usage: python -m benchmarks.planners.constrained [SUITE[/LEVEL] ...] [-n 17] [--unseen 67] [--rows NAME ...] [--jobs 1]
       [--clock cpu] [--split validation] [--report]
       python -m benchmarks.planners.constrained --motions 5 [--jobs 1]
       python -m benchmarks.planners.constrained --tune NAME ...
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.api import plan
from apex_ompl.errors import UnknownNameError
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.evaluation.summary import Statistics
from apex_ompl.ompl.parameters import register
from apex_ompl.problems.catalogue import CONSTRAINED, SPLITS, VALIDATION
from apex_ompl.result import FIRST, PlanResult
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.rest_to_rest import direct_durations
from apex_ompl.scene.problem import Problem
from apex_ompl.util.clocks import timed
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.planners.constrained_cbirrt import NAME as BASE
from benchmarks.planners.constrained_cbirrt import CbirrtParameters
from benchmarks.planners.constrained_check import DENSE, DenseCheck, dense_check, problem_of

DEPENDS = (
    "@benchmark", "apex_ompl/constraints", "apex_ompl/timing", "benchmarks/planners/constrained_cbirrt.py",
    "benchmarks/planners/constrained_check.py", "benchmarks/planners/constrained_clock.py",
    "benchmarks/planners/constrained_ompl.py", "benchmarks/planners/constrained_sscbirrt.py",
    "benchmarks/planners/constrained_roboplan.py", "benchmarks/planners/peers.py",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs" / "constrained"
TIMEOUT = 1.0  # [s]
MOTION_TIMEOUT = 4.0  # of the calls of --motions [s]
TUNED_ON = 8  # first validation problems of a level, which are for tuning
RUNGS = ((8, 1), (2, 2))  # candidates that are left, and problems of a level
CLOCK = "benchmarks.planners.constrained_clock"
OWN, MOTIONS, OMPL, SSCBIRRT, ROBOPLAN = (
    f"benchmarks.planners.{name}"
    for name in (
        "constrained:plan_with_apex", "constrained:motions_of_apex", "constrained_ompl:plan_with_ompl",
        "constrained_sscbirrt:plan_with_sscbirrt", "constrained_roboplan:plan_with_roboplan",
    )
)  # fmt: skip
PACKAGES = {SSCBIRRT: "sscbirrt", ROBOPLAN: "roboplan"}
NO_PROPOSALS = {"model": "none", "first": 0, "second": 0, "third": 0, "resample": 0}
APEX = "apex"
TUNED: Mapping[str, Mapping[str, Any]] = {
    BASE: {"longest": 0.3},
    "ompl projected": {"delta": 0.1, "stretch": 4.0, "range": 1.0},
    "ompl atlas": {"delta": 0.2, "rho": 0.5, "range": 1.5},
    "ompl tangent bundle": {"delta": 0.1, "rho": 0.5},
    "sscbirrt": {"step_size": 0.3, "extend_steps": 3},
    "roboplan": {"max_connection_distance": 1.5},
}
"""Row -> the parameters that ``--tune`` chose."""
ROWS = (
    Row(APEX, "apex", runner=OWN),
    Row("apex without network", "apex", {"model": "none"}, runner=OWN),
    Row("line + LM", "apex", {**NO_PROPOSALS, "sprint": 0, "fallback": False}, runner=OWN),
    Row(BASE, BASE, TUNED[BASE], runner=OWN),
    Row("ompl projected", "projected", TUNED["ompl projected"], runner=OMPL),
    Row("ompl atlas", "atlas", TUNED["ompl atlas"], runner=OMPL),
    Row("ompl tangent bundle", "tangent_bundle", TUNED["ompl tangent bundle"], runner=OMPL),
    Row("sscbirrt", "sscbirrt", TUNED["sscbirrt"], runner=SSCBIRRT),
    Row("roboplan", "roboplan", TUNED["roboplan"], runner=ROBOPLAN),
)
SHORTENS = (BASE, "ompl projected", "ompl atlas", "ompl tangent bundle")
CHARTS = (
    {}, {"delta": 0.2}, {"delta": 0.1, "rho": 0.5}, {"delta": 0.2, "rho": 0.5}, {"delta": 0.2, "rho": 1.0},
    {"delta": 0.2, "exploration": 0.5}, {"delta": 0.2, "rho": 0.5, "alpha": 0.6, "epsilon": 0.2},
    {"delta": 0.2, "rho": 0.5, "range": 1.5},
)  # fmt: skip
CANDIDATES: Mapping[str, Sequence[Mapping[str, Any]]] = {
    BASE: (
        {}, {"longest": 0.1}, {"longest": 0.2}, {"longest": 0.3}, {"longest": 0.15, "pieces": 1},
        {"longest": 0.3, "pieces": 4}, {"draws": 100}, {"draws": 300},
    ),
    "ompl projected": (
        {}, {"range": 0.3}, {"range": 1.0}, {"delta": 0.1}, {"delta": 0.2}, {"delta": 0.2, "range": 0.6},
        {"delta": 0.2, "range": 1.5}, {"delta": 0.1, "stretch": 4.0, "range": 1.0},
    ),
    "ompl atlas": CHARTS,
    "ompl tangent bundle": CHARTS,
    "sscbirrt": (
        {}, {"step_size": 0.2}, {"step_size": 0.3}, {"edge_resolution": 0.03}, {"step_size": 0.3, "extend_steps": 3},
        {"step_size": 0.3, "extend_steps": 10}, {"extend_steps": 10}, {"step_size": 0.2, "connect_steps": 20},
    ),
    "roboplan": (
        {}, {"max_connection_distance": 0.3}, {"max_connection_distance": 0.7}, {"max_connection_distance": 1.5},
        {"path_step_size": 0.05}, {"max_connection_distance": 0.7, "path_step_size": 0.2},
        {"path_step_size": 0.2}, {"max_connection_distance": 0.7, "path_step_size": 0.05},
    ),
}  # fmt: skip
"""Row -> the parameters that are tried on validation problems, eight candidates each; the first has the defaults."""


def checked_motion(robot: Robot, problem: Problem, result: PlanResult) -> DenseCheck:
    """Return the dense check of the motion of a result, which has one."""
    assert result.trajectory is not None
    spacing = DENSE / float(robot.limits.velocity.max())
    return dense_check(robot, problem, result.trajectory.sample(spacing).position)


def plan_with_apex(job: Job) -> Run:
    """Return the columns of a run of ``apex_ompl.plan``, with the dense checks of its path and its motion."""
    register(BASE)(CbirrtParameters)
    problem, started = problem_of(job), time.process_time()
    result = plan(problem, job.planner, timeout=job.timeout, seed=job.seed, params=dict(job.params))
    cpu, times = time.process_time() - started, dict(result.times)
    found: Run = {
        "solved": bool(result), "status": str(result.status), "reason": result.reason, "by": result.solved_by,
        "first": None, "total": times["total"] - times.get("setup", 0.0), "cpu": cpu, "times": times, "length": None,
        "failed_check": False, "violation": None, "duration": None, "direct": None,
    }  # fmt: skip
    if not result or result.path is None or result.trajectory is None:
        return found
    robot, states = load_robot(problem.robot), result.path.states
    with timed(times, "check"):
        checks = [dense_check(robot, problem, states), checked_motion(robot, problem, result)]
    passed, line = all(checks), times.get("line", 0.0)
    first = line + times.get(FIRST, times.get("solve", 0.0))
    return found | {
        "solved": passed, "first": first if passed else None, "length": result.length, "failed_check": not passed,
        "violation": max(check.violation for check in checks), "duration": result.trajectory.duration,
        "direct": float(direct_durations(states[0], states[-1:], robot.limits)[0]),
        "reason": "" if passed else "the path or the motion failed the dense check",
    }  # fmt: skip


def motions_of_apex(job: Job) -> Run:
    """Return the columns of calls of ``plan`` with the seeds from 1 to ``seeds``, and the dense checks of motions."""
    problem = problem_of(job)
    robot, violations, states, late = load_robot(problem.robot), list[float](), 0, 0
    faults, started = list[int](), time.process_time()
    for seed in range(1, job.params["seeds"] + 1):
        result = plan(problem, job.planner, timeout=job.timeout, seed=seed)
        if not result:
            late += 1
            continue
        check = checked_motion(robot, problem, result)
        violations.append(check.violation)
        states += check.states
        if not check:
            faults.append(seed)
    return {
        "solved": not late and not faults, "violations": violations, "states": states, "unsolved": late,
        "faults": faults, "cpu": time.process_time() - started,
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


def candidates(name: str) -> list[Row]:
    """Return rows with the parameters that are tried of a row, the defaults first."""
    row = next(row for row in ROWS if row.label == name)
    return [Row.of(row.planner, params, runner=row.runner) for params in CANDIDATES[name]]


def group_of(problem: str) -> str:
    """Return the group of a problem: its level over all suites, of ``unseen`` apart."""
    suite, level, _ = problem.split("/")
    return f"unseen, {level}" if suite in VALIDATION else f"suites, {level}"


def summary(runs: Sequence[Run], base: Mapping[str, float], best: Mapping[str, float]) -> dict[str, Any]:
    """Return the statistics of the runs of a row.

    Args:
        runs: The runs, at least one of them on a problem that the row can have.
        base: Length that lengths are compared with, by problem [rad].
        best: Duration that durations are compared with, by problem [s].
    """
    made = [run for run in runs if run["status"] != NO_PROBLEM]
    found = Statistics("", "", made)
    pairs = [run["length"] / base[run["problem"]] for run in found.solved if base.get(run["problem"])]
    violations = [run["violation"] for run in found.solved if run.get("violation") is not None]
    moved = [run for run in found.solved if run.get("duration")]
    cpu = [run["cpu"] for run in made if run.get("cpu") is not None]

    def over(values: Iterable[float]) -> list[float] | None:
        return record.percentiles(list(values), 50, 95) if moved else None

    return {
        "n": len(made), "left_out": len(runs) - len(made), "solved": len(found.solved) / len(made),
        "interval": share_interval(len(found.solved), len(made)),
        "first_s": [record.reached(found.times("first"), p) for p in (50, 95)],
        "cpu_s": [record.reached(cpu, p) for p in (50, 95)],
        "failed_check": sum(run.get("failed_check", False) for run in made),
        "violation": max(violations, default=None), "length": found.median("length"),
        "length_ratio": math.exp(float(np.mean(np.log(pairs)))) if pairs else None, "pairs": len(pairs),
        "duration_over_direct": over(run["duration"] / run["direct"] for run in moved),
        "duration_over_best": over(run["duration"] / best[run["problem"]] for run in moved),
    }  # fmt: skip


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{1e3 * value:.0f}"


def _ratios(values: Sequence[float] | None) -> list[str]:
    return ["-", "-"] if values is None else [f"{value:.3f}" for value in values]


HEAD = (
    "problems", "row", "N", "left out", "solved (95 %, Wilson)", "first path ms p50", "p95", "call CPU ms p50", "p95",
    f"length / {BASE}'s (N)", "duration / direct p50", "p95", "duration / best p50", "p95", "violation / tolerance",
    "faults",
)  # fmt: skip


def tabulate(results: Results, rows: Sequence[Row]) -> tuple[dict[str, Any], str]:
    """Return the statistics of each row on groups of problems, and Markdown tables of them, and of pairs with apex."""
    runs, best = results.runs, dict[str, float]()
    base = {run["problem"]: run["length"] for run in runs if run["label"] == BASE and run["solved"]}
    for run in runs:
        if run["solved"] and run.get("duration"):
            best[run["problem"]] = min(run["duration"], best.get(run["problem"], math.inf))
    groups = sorted({group_of(run["problem"]) for run in runs})
    lines = [record.row(list(HEAD)), record.row(["---", "---", *["---:"] * (len(HEAD) - 2)])]
    found: dict[str, Any] = {}
    for group in ("suites", "unseen", *groups):
        for row in rows:
            mine = [r for r in runs if r["label"] == row.label and group_of(r["problem"]).startswith(group)]
            if all(run["status"] == NO_PROBLEM for run in mine):
                continue
            f = found[f"{group}, {row.label}"] = summary(mine, base, best)
            low, high = f["interval"]
            ratio = "-" if f["length_ratio"] is None else f"{f['length_ratio']:.2f} ({f['pairs']})"
            lines.append(
                record.row([
                    group, row.label, f["n"], f["left_out"] or "", f"{f['solved']:.3f} ({low:.3f} to {high:.3f})",
                    *map(_ms, (*f["first_s"], *f["cpu_s"])), ratio, *_ratios(f["duration_over_direct"]),
                    *_ratios(f["duration_over_best"]), "-" if f["violation"] is None else f"{f['violation']:.2f}",
                    f["failed_check"],
                ])
            )  # fmt: skip
    pairs, table = paired(runs, rows)
    left_out = sorted({run["reason"] for run in runs if run["status"] == NO_PROBLEM})
    notes = [f"Left out: problems where {'; '.join(left_out)}."] if left_out else []
    unsolved = sorted({run["problem"] for run in runs} - {run["problem"] for run in runs if run["solved"]})
    notes += [f"Solved by no row: {', '.join(unsolved) or 'none'}."]
    return {"groups": found, "pairs": pairs, "unsolved": unsolved}, "\n\n".join(["\n".join(lines), *notes, table])


def paired(runs: Sequence[Run], rows: Sequence[Row]) -> tuple[dict[str, Any], str]:
    """Return apex beside each other row on the problems that the row has had, and a Markdown table."""
    head = ["problems", "row", "N", "solved", "apex", "both", "first path ms p50", "apex", "p95", "apex"]
    head += ["length / apex's"]
    lines = [record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 2)])]
    ours, found = {run["problem"]: run for run in runs if run["label"] == APEX}, dict[str, Any]()
    for group in ("suites", "unseen"):
        for row in rows:
            theirs = [
                run
                for run in runs
                if run["label"] == row.label != APEX and run["problem"] in ours and run["status"] != NO_PROBLEM
                and group_of(run["problem"]).startswith(group)
            ]  # fmt: skip
            if not theirs:
                continue
            both = [(run, ours[run["problem"]]) for run in theirs]
            times = [Statistics("", "", list(side)).times("first") for side in zip(*both, strict=True)]
            solved = [(a, b) for a, b in both if a["solved"] and b["solved"]]
            ratios = [a["length"] / b["length"] for a, b in solved]
            f = found[f"{group}, {row.label}"] = {
                "n": len(both), "solved": [sum(run["solved"] for run in side) for side in zip(*both, strict=True)],
                "both": len(solved), "first_s": [[record.reached(side, p) for side in times] for p in (50, 95)],
                "length_ratio": math.exp(float(np.mean(np.log(ratios)))) if ratios else None,
            }  # fmt: skip
            ratio = "-" if f["length_ratio"] is None else f"{f['length_ratio']:.2f}"
            first = [_ms(value) for values in f["first_s"] for value in values]
            lines.append(record.row([group, row.label, f["n"], *f["solved"], f["both"], *first, ratio]))
    return found, "\n".join(lines)


def score(runs: Sequence[Run], shortest: Mapping[str, float], *, shortens: bool) -> float:
    """Return the score of a candidate, the lower the better [s].

    Args:
        runs: Its runs.
        shortest: Least length of all candidates, by problem [rad].
        shortens: Whether lengths count.
    """
    times = [run["first"] if run["solved"] else 2.0 * TIMEOUT for run in runs]
    lengths = [run["length"] / shortest[run["problem"]] if run["solved"] else 2.0 for run in runs]
    return float(np.mean(times)) * (float(np.mean(lengths)) if shortens else 1.0)


def tune(names: Sequence[str], levels: Sequence[str], store: Path, workers: Workers) -> None:
    """Try the candidates of rows on validation problems, and write their scores."""
    lines = [record.row(["row", "candidate", *(f"score ms on {n} of each level" for _, n in RUNGS), "solved"])]
    lines.append(record.row(["---", "---", *["---:"] * (len(RUNGS) + 1)]))
    data = dict[str, dict[str, Any]]()
    for name in names:
        results, scores = tuned(name, levels, store, workers)
        data[name] = {}
        for label in sorted(scores[0], key=lambda label: [s.get(label, math.inf) for s in scores[::-1]]):
            runs = [run for run in results if run["label"] == label]
            count = [sum(run["solved"] for run in runs), len(runs)]
            data[name][label] = {"scores_s": [s.get(label) for s in scores], "solved": count}
            lines.append(record.row([name, label, *(_ms(s.get(label)) for s in scores), f"{count[0]} of {count[1]}"]))
    about = {"limit": f"{TIMEOUT:g} s", "seeds": "0", "clock": "cpu", **record.made_with(Results.load(store))}
    record.write("constrained_tuning", {"rows": data}, "\n".join(lines), split="validation", **about)


def tuned(
    name: str, levels: Sequence[str], store: Path, workers: Workers
) -> tuple[list[Run], list[dict[str, float]]]:  # fmt: skip
    """Run the candidates of a row on validation problems, and return the runs and the scores of each rung."""
    rows, scores, made = candidates(name), list[dict[str, float]](), dict[str, Run]()
    for keep, count in RUNGS:
        rows = sorted(rows, key=lambda row: scores[-1][row.label])[:keep] if scores else rows
        ids = [problem for level in levels for problem in problems_of(level, count, tune=True)]
        results = bench(
            ids, rows, store, runs=1, timeout=TIMEOUT, split="validation", workers=workers,
            provenance=record.session(),
        )  # fmt: skip
        mine = {row.label: [r for r in runs_of(results, ids, [row]) if r["status"] != NO_PROBLEM] for row in rows}
        made |= {run["key"]: run for runs in mine.values() for run in runs}
        shortest = dict[str, float]()
        for run in (run for runs in mine.values() for run in runs if run["solved"]):
            shortest[run["problem"]] = min(run["length"], shortest.get(run["problem"], math.inf))
        scores.append({label: score(runs, shortest, shortens=name in SHORTENS) for label, runs in mine.items()})
    return list(made.values()), scores


def runs_of(results: Results, ids: Iterable[str], rows: Iterable[Row]) -> list[Run]:
    """Return the runs of some rows on some problems."""
    labels, chosen = {row.label for row in rows}, set(ids)
    return [run for run in results.runs if run["problem"] in chosen and run["label"] in labels]


def available(rows: Sequence[Row]) -> list[Row]:
    """Return the rows whose packages are installed; name the others."""
    missing = [row for row in rows if row.runner in PACKAGES and not importlib.util.find_spec(PACKAGES[row.runner])]
    for row in missing:
        print(f"no {PACKAGES[row.runner]}: {row.label} is left out")
    return [row for row in rows if row not in missing]


def write_motions(seeds: int, ids: Sequence[str], store: Path, workers: Workers, split: str) -> None:
    """Plan each problem with several seeds, check the motions, and write what was found."""
    row = Row("motions", "apex", {"seeds": seeds}, runner=MOTIONS)
    results = bench(
        ids, [row], store, runs=1, timeout=MOTION_TIMEOUT, split=split, workers=workers, provenance=record.session()
    )
    runs = runs_of(results, ids, [row])
    head = ["problems", "N", "seeds", "unsolved", "motions", "states", "violation / tolerance p50", "max", "faults"]
    lines, data = [record.row(head), record.row(["---", *["---:"] * (len(head) - 1)])], {}
    for group in ("suites", "unseen", ""):
        mine = [run for run in runs if group_of(run["problem"]).startswith(group) and "violations" in run]
        violations = [value for run in mine for value in run["violations"]]
        if not violations:
            continue
        f = data[group or "all"] = {
            "n": len(mine), "unsolved": sum(run["unsolved"] for run in mine), "motions": len(violations),
            "states": sum(run["states"] for run in mine), "violation": [float(np.median(violations)), max(violations)],
            "faults": [f"{run['problem']}, seed {seed}" for run in mine for seed in run["faults"]],
        }  # fmt: skip
        worst = [f"{value:.3f}" for value in f["violation"]]
        lines.append(
            record.row([
                group or "all", f["n"], seeds, f["unsolved"], f["motions"], f["states"], *worst, len(f["faults"])
            ])
        )  # fmt: skip
    lost = sum("violations" not in run for run in runs)
    about = {"limit": f"{MOTION_TIMEOUT:g} s", "seeds": f"1 to {seeds}", "lost": lost, **record.made_with(results)}
    record.write("constrained_motions", {"groups": data}, "\n".join(lines), split=_split(split), **about)


def _split(split: str) -> str:
    return f"{split}, of unseen validation" if split == "test" else split


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command."""
    found = record.parser(__doc__, n=17, jobs=1)
    found.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    found.add_argument(
        "--unseen", type=one_or_more, default=67, help="problems of a level of unseen (default: %(default)s)"
    )
    names = [row.label for row in ROWS]
    found.add_argument("--rows", nargs="*", choices=names, default=names, metavar="NAME", help="(default: all)")
    found.add_argument(
        "--tune", nargs="+", choices=CANDIDATES, metavar="NAME", help="try candidates of rows, by CPU time"
    )
    found.add_argument("--motions", type=one_or_more, metavar="SEEDS", help="check motions of apex with several seeds")
    found.add_argument("--clock", choices=("wall", "cpu"), default="wall", help="time that limits and times are")
    found.add_argument("--split", choices=("test", "validation"), default="test", help="(default: %(default)s)")
    found.add_argument("--report", action="store_true", help="write the results of the runs that are stored")
    found.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    return found


def main() -> None:
    """Run what is missing, and write the results."""
    args = parser().parse_args()
    levels, validation = levels_of(args.levels), args.split == "validation"
    modules = (CLOCK,) if args.clock == "cpu" or args.tune else ()
    workers = Workers(args.jobs, modules=modules)
    if args.tune:
        names = [row.label for row in available([row for row in ROWS if row.label in args.tune])]
        tune(names, levels[::2], args.store.with_name(f"{args.store.name}_tuning"), workers)
        return
    per_level = {level: args.unseen if level.startswith("unseen/") else args.n for level in levels}
    by_level = [problems_of(level, count, tune=validation) for level, count in per_level.items()]
    ids = [problem for some in itertools.zip_longest(*by_level) for problem in some if problem]
    name = "_".join([args.store.name, *([] if args.split == "test" else [args.split])])
    if args.motions:
        write_motions(args.motions, ids, args.store.with_name(f"{name}_motions"), workers, args.split)
        return
    store = args.store.with_name("_".join([name, *([] if args.clock == "wall" else [args.clock])]))
    rows = available([row for row in ROWS if row.label in args.rows])
    own, rivals = ([row for row in rows if (row.runner == OWN) is ours] for ours in (True, False))
    for some in (own, rivals):  # so that a run that is stopped has those of this project
        if some and not args.report:
            bench(
                ids, some, store, runs=1, timeout=TIMEOUT, split=args.split, workers=workers,
                provenance=record.session(),
            )  # fmt: skip
    results = Results.load(store)
    results = replace(results, runs=runs_of(results, ids, rows))
    data, table = tabulate(results, rows)
    about = {"split": _split(args.split), "limit": f"{TIMEOUT:g} s", "clock": args.clock, "seeds": "0"}
    about |= {"tuned": "; ".join(f"{label} {dict(params)}" for label, params in TUNED.items())}
    about |= {PACKAGES[row.runner]: version(PACKAGES[row.runner]) for row in rows if row.runner in PACKAGES}
    record.write(name, data, table, **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
