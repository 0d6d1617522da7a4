"""Time of planners to a short path: one within 10 % of the length that aorrtc has after 30 s.

The reference lengths are made once (``--reference``), on the first 20 test problems of each hard level, and kept in
benchmarks/reference_lengths.json. Then each planner has 10 s: apex, which improves its path all the time (``anytime``);
rrtconnect with OMPL's simplification, and rrtconnect+polish, restarted with other random numbers as long as there is
time; aorrtc; rrtconnect and aorrtc as OMPL has them, and with the parameters that benchmarks/planners/tune.py chose,
which their labels name. A path counts from when it has passed the full check, as first paths do in
apex_ompl.evaluation. Each run is stored in benchmarks/runs/time_to_quality when it ends; the command resumes where it
was stopped.

Usage: python -m benchmarks.planners.time_to_quality [--reference] [SUITE/hard ...] [-n 10] [--jobs 1]
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ompl import base as ob

from apex_ompl import planners
from apex_ompl.evaluation import Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.ompl.repair import simplify
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.space import path_to_array
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import path_length
from apex_ompl.problems import load
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from benchmarks.lib import record

REFERENCE = Path(__file__).parents[1] / "reference_lengths.json"
FOLDER = Path(__file__).parents[1] / "runs" / "time_to_quality"
DEPENDS = ("@benchmark", "benchmarks/reference_lengths.json")
REFERENCE_TIMEOUT, TIMEOUT, WITHIN = 30.0, 10.0, 1.1  # [s], [s], factor on the length
ALL_HARD = "all"
PERIOD = 0.005  # at which a planner's best path is read [s]
RUNNER = "benchmarks.planners.time_to_quality:improve"
ROWS = (
    Row("apex", "apex", {"anytime": True}, runner=RUNNER),
    Row("rrtconnect", "rrtconnect", runner=RUNNER),
    Row.of("rrtconnect", TUNED["rrtconnect"], runner=RUNNER),
    Row("rrtconnect+polish", "rrtconnect+polish", TUNED["rrtconnect+polish"], runner=RUNNER),
    Row("aorrtc", "aorrtc", runner=RUNNER),
    Row.of("aorrtc", TUNED["aorrtc"], runner=RUNNER),
)
METHODS = tuple(row.label for row in ROWS)
REFERENCE_ROW = Row("reference", "aorrtc", timeout=REFERENCE_TIMEOUT, runner=RUNNER)
Lengths = list[tuple[float, float]]
"""Time at which a path had passed the full check [s], and its length [rad]; each shorter than those before."""


def passes_full_check(ready: PlanningSetup, path: np.ndarray) -> bool:
    """Whether a path passes the full check between the given ends, as they are bit for bit."""
    states = np.concatenate([ready.start[None], path[1:-1], ready.goals[0][None]])
    return bool(full_check(ready.checker, states, ready.start, ready.goals))


def observed(ready: PlanningSetup, planner: ob.Planner, limit: float) -> Lengths:
    """Run a planner, read its best path periodically, and return the lengths; each path is checked afterwards."""
    setup, found = ready.simple_setup, list[tuple[float, np.ndarray]]()
    pdef, begin, last = setup.getProblemDefinition(), time.perf_counter(), [0.0]

    def over() -> bool:
        now = time.perf_counter() - begin
        if now - last[0] > PERIOD or now > limit:
            last[0] = now
            if pdef.hasExactSolution():
                path = path_to_array(pdef.getSolutionPath(), ready.robot.dof)
                if not found or path_length(path) < path_length(found[-1][1]):
                    found.append((now, path))
        return now > limit

    setup.setPlanner(planner)
    setup.setup()
    begin = time.perf_counter()
    setup.solve(ob.PlannerTerminationCondition(over))
    over()
    lengths: Lengths = []
    for took, path in found:
        check = time.perf_counter()
        if passes_full_check(ready, path):
            lengths.append((took + time.perf_counter() - check, path_length(path)))
    return shorter(lengths)


def shorter(lengths: Lengths) -> Lengths:
    """Return those that are shorter than all before."""
    found: Lengths = []
    for took, length in lengths:
        if not found or length < found[-1][1]:
            found.append((took, length))
    return found


def apex(ready: PlanningSetup, job: Job) -> Lengths:
    """Run apex, which improves its path until time is up."""
    setup = ready.simple_setup
    planner = planners.parameters("apex", seed=job.seed, **job.params).build(setup.getSpaceInformation())
    setup.setPlanner(planner)
    setup.setup()
    setup.solve(ob.timedPlannerTerminationCondition(job.timeout))
    return shorter(planner.report.lengths)


def repeated(attempt: Callable[[float], np.ndarray | None], ready: PlanningSetup, limit: float) -> Lengths:
    """Make attempts until time is up, and return the lengths."""
    begin, found = time.perf_counter(), list[tuple[float, float]]()
    while (left := limit - (time.perf_counter() - begin)) > 0.0:
        path = attempt(left)
        if path is not None and passes_full_check(ready, path) and (took := time.perf_counter() - begin) <= limit:
            found.append((took, path_length(path)))
    return shorter(found)


def attempts(ready: PlanningSetup, job: Job) -> Lengths:
    """Run a planner repeatedly, and simplify its paths unless they are smooth."""
    setup, parameters = ready.simple_setup, planners.parameters(job.planner, **job.params)
    si = setup.getSpaceInformation()

    def attempt(left: float) -> np.ndarray | None:
        setup.clear()
        setup.setPlanner(parameters.build(si))
        setup.setup()
        status = setup.solve(ob.timedPlannerTerminationCondition(left)).getStatus()
        if status != ob.PlannerStatus.EXACT_SOLUTION:
            return None
        path = path_to_array(setup.getSolutionPath(), ready.robot.dof)
        return path if parameters.smooth else simplify(si, path)

    return repeated(attempt, ready, job.timeout)


def improve(job: Job) -> Run:
    """Return the columns of a run; ``lengths`` are those of its paths, ``total`` is the time of the last of them."""
    ready = assemble(load(job.problem), robot())
    if job.planner == "apex":
        found = apex(ready, job)
    elif job.planner == "aorrtc":
        setup = ready.simple_setup
        si = setup.getSpaceInformation()
        setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
        found = observed(ready, planners.parameters("aorrtc", **job.params).build(si), job.timeout)
    else:
        found = attempts(ready, job)
    if not found:
        return {"solved": False, "lengths": found}
    (first, _), (total, length) = found[0], found[-1]
    return {"solved": True, "first": first, "total": total, "length": length, "lengths": found}


def reached(lengths: Lengths, wanted: float) -> float:
    """Return the time to the first path that is as short as wanted, infinite without one [s]."""
    return next((took for took, length in lengths if length <= wanted), math.inf)


def quality(done: dict[Any, Any], names: list[str], method: str, kept: dict[str, float]) -> dict[str, Any]:
    """Return the share of problems on which a planner reached the wanted lengths, and the times."""
    lengths = [done[name, method].get("lengths", []) for name in names]
    ratios = [one[-1][1] / kept[name] for name, one in zip(names, lengths, strict=True) if one]
    known = [min([kept[n]] + [one[-1][1] for m in METHODS if (one := done[n, m].get("lengths"))]) for n in names]
    found: dict[str, Any] = {
        "n": len(names), "ratio": float(np.exp(np.mean(np.log(ratios)))) if ratios else None,
        "no_path": len(names) - len(ratios),
    }  # fmt: skip
    for end, wanted in (("", [kept[name] for name in names]), ("_shortest", known)):
        times = [reached(one, WITHIN * length) for one, length in zip(lengths, wanted, strict=True)]
        found |= {f"reached{end}": float(np.mean(np.isfinite(times)))}
        found |= {f"s{end}": [record.reached(times, p) for p in (50, 95)]}
    return found


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=10, of="test problems of a level", jobs=1)
    parser.add_argument("levels", nargs="*", metavar="SUITE/hard")
    parser.add_argument("--reference", action="store_true", help="make the reference lengths, 30 s for each problem")
    args = parser.parse_args()
    levels = [level for level in record.static_levels(args.levels) if level.endswith("/hard")]
    results = bench(
        levels, [REFERENCE_ROW] if args.reference else ROWS, FOLDER, runs=args.n, timeout=TIMEOUT,
        workers=Workers(args.jobs), provenance=record.session(),
    )  # fmt: skip
    wanted = [run for run in results.runs if run["experiment"] in levels and run["seed"] < args.n]
    results = replace(results, runs=[r for r in wanted if (r["label"] == REFERENCE_ROW.label) is args.reference])
    done = {(run["problem"], run["label"]): run for run in results.runs if run["status"] != NO_PROBLEM}
    names = sorted({name for name, _ in done})
    kept = json.loads(REFERENCE.read_text()) if REFERENCE.is_file() else {}
    if args.reference:
        made = {name: run["length"] for (name, _), run in done.items() if run["solved"]}
        write_atomically(REFERENCE, (json.dumps({**kept, **made}, indent=1, sort_keys=True) + "\n").encode())
        print(f"{REFERENCE.name}: {len(kept | made)} lengths")
        return
    head = ["level", "method", "N", "reached", "s p50", "p95", "last length / reference (geometric mean)", "no path"]
    head += ["reached the shortest known", "s p50", "p95"]
    rows = [record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 2)])]
    figures: dict[str, Any] = {}
    measured = [name for name in names if name in kept]
    for level in (*levels, ALL_HARD):
        mine = [name for name in measured if level == ALL_HARD or name.startswith(f"{level}/")]
        for k, method in enumerate(METHODS if mine else ()):
            f = figures[f"{level}, {method}"] = quality(done, mine, method, kept)
            shares = [f"{f[key]:.2f}" for key in ("reached", "reached_shortest")]
            slow = [["-" if v is None else f"{v:.2f}" for v in f[key]] for key in ("s", "s_shortest")]
            ratio = "-" if f["ratio"] is None else f"{f['ratio']:.2f}"
            cells = [level if k == 0 else "", method, f["n"], shares[0], *slow[0], ratio, f["no_path"], shares[1]]
            rows.append(record.row([*cells, *slow[1]]))
    without = sum(name not in kept for name in names)
    text = f"\n\n{without} of {len(names)} problems are left out: aorrtc has no path after {REFERENCE_TIMEOUT:g} s."
    limits = f"{TIMEOUT:g} s, within {WITHIN:g} of aorrtc's length after {REFERENCE_TIMEOUT:g} s"
    about = {"limit": limits, **record.made_with(results)}
    record.write("time_to_quality", {"levels": figures}, "\n".join(rows) + text, split="test", **about)


if __name__ == "__main__":
    run_script(main)
