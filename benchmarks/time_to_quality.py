"""How long planners take to a short path: one within 10 % of the length that aorrtc has after 30 s.

The lengths to come up to are made once (``--reference``), on the first 20 test problems of each hard level, and kept in
benchmarks/reference_lengths.json. Then each planner has 10 s: apex, improving its path all the time (``anytime``);
rrtconnect and OMPL's simplification, and rrtconnect+polish, begun anew with other random numbers as long as there is
time, their best path kept; aorrtc. Paths count from when they are found, if they pass the full check, which is part of
the time only where the planner makes it itself.

Usage: python benchmarks/time_to_quality.py [--reference] [SUITE/hard ...] [-n 20] [--jobs 1]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import record
import torch
from ompl import base as ob
from ompl import geometric as og
from store import RunStore

from apex_ompl import planners, problems
from apex_ompl.ompl_adapter.process import quiet_ompl, seed_ompl
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.simplify import simplify
from apex_ompl.ompl_adapter.space import path_to_array
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.reach import robot
from apex_ompl.trajopt.path import path_length
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import one_or_more

REFERENCE = Path(__file__).parent / "reference_lengths.json"
STORE = Path(__file__).parent / "runs" / "time_to_quality.jsonl"
LONG, LIMIT, WITHIN = 30.0, 10.0, 1.1  # [s], [s], factor on the length
ALL_HARD = "all"
LOOK = 0.005  # between two looks at a planner's best path [s]
METHODS = ("apex", "rrtconnect", "rrtconnect+polish", "aorrtc")
Lengths = list[tuple[float, float]]
"""Seconds, and the length of a path that passed the full check [rad]; each shorter than those before."""


def proven(ready: PlanningSetup, path: np.ndarray) -> bool:
    """Whether a path passes the full check between the given ends, as they are bit for bit."""
    states = np.concatenate([ready.start[None], path[1:-1], ready.goals[0][None]])
    return bool(full_check(ready.checker, states, ready.start, ready.goals))


def watched(ready: PlanningSetup, planner: ob.Planner, limit: float) -> Lengths:
    """Let a planner run, look at its best path all the time, and return what it came to."""
    setup, found = ready.simple_setup, list[tuple[float, np.ndarray]]()
    pdef, begin, last = setup.getProblemDefinition(), time.perf_counter(), [0.0]

    def over() -> bool:
        now = time.perf_counter() - begin
        if now - last[0] > LOOK or now > limit:
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
    return shorter([(took, path_length(path)) for took, path in found if proven(ready, path)])


def shorter(lengths: Lengths) -> Lengths:
    """Return those that are shorter than all before."""
    found: Lengths = []
    for took, length in lengths:
        if not found or length < found[-1][1]:
            found.append((took, length))
    return found


def apex(ready: PlanningSetup, seed: int) -> Lengths:
    """Let apex improve its path until time is up."""
    setup = ready.simple_setup
    planner = planners.parameters("apex", seed=seed, anytime=True).build(setup.getSpaceInformation())
    setup.setPlanner(planner)
    setup.setup()
    setup.solve(ob.timedPlannerTerminationCondition(LIMIT))
    return shorter(planner.report.lengths)


def again(attempt: Callable[[float], np.ndarray | None], ready: PlanningSetup) -> Lengths:
    """Make attempts until time is up."""
    begin, found = time.perf_counter(), list[tuple[float, float]]()
    while (left := LIMIT - (time.perf_counter() - begin)) > 0.0:
        path = attempt(left)
        took = time.perf_counter() - begin
        if path is not None and took <= LIMIT and proven(ready, path):
            found.append((took, path_length(path)))
    return shorter(found)


def attempts(ready: PlanningSetup, name: str) -> Lengths:
    """Run a planner again and again, and simplify what it finds unless that is smooth."""
    setup, parameters = ready.simple_setup, planners.parameters(name)
    si = setup.getSpaceInformation()

    def attempt(left: float) -> np.ndarray | None:
        setup.clear()
        setup.setPlanner(parameters.build(si))
        setup.setup()
        status = setup.solve(ob.timedPlannerTerminationCondition(left)).getStatus()
        if status != ob.PlannerStatus.EXACT_SOLUTION:
            return None
        path = path_to_array(setup.getSolutionPath(), ready.robot.dof)
        return path if parameters.smooth else simplify(og.PathSimplifier(si), si, path)

    return again(attempt, ready)


def run(job: tuple[str, str]) -> dict[str, Any]:
    """Return what a planner came to on a problem."""
    name, method = job
    seed = int(name.rsplit("/", 1)[1]) % 1000
    with quiet_ompl():
        seed_ompl(seed)
        ready = assemble(problems.load(name), robot())
        if method == "apex":
            found = apex(ready, seed)
        elif method in ("aorrtc", "reference"):
            setup = ready.simple_setup
            si = setup.getSpaceInformation()
            setup.setOptimizationObjective(ob.PathLengthOptimizationObjective(si))
            planner = planners.parameters("aorrtc").build(si)
            found = watched(ready, planner, LONG if method == "reference" else LIMIT)
        else:
            found = attempts(ready, method)
    return {"problem": name, "method": method, "lengths": found}


def warm_up() -> None:
    """Load the kernel, the robot, the model."""
    torch.set_num_threads(1)
    ready = assemble(problems.load("wall/easy/800000"), robot())
    with quiet_ompl():
        planner = planners.parameters("apex", seed=0).build(ready.simple_setup.getSpaceInformation())
        ready.simple_setup.setPlanner(planner)
        ready.simple_setup.solve(ob.timedPlannerTerminationCondition(1.0))


def reached(lengths: Lengths, wanted: float) -> float:
    """Return the time to the first path that is as short as wanted, infinite without one [s]."""
    return next((took for took, length in lengths if length <= wanted), math.inf)


def quality(done: dict[Any, Any], names: list[str], method: str, kept: dict[str, float]) -> dict[str, Any]:
    """Return how many of some problems a planner reached the wanted lengths on, and when."""
    lengths = [done[name, method]["lengths"] for name in names]
    ratios = [one[-1][1] / kept[name] for name, one in zip(names, lengths, strict=True) if one]
    known = [min([kept[n]] + [one[-1][1] for m in METHODS if (one := done[n, m]["lengths"])]) for n in names]
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE/hard")
    parser.add_argument("-n", type=one_or_more, default=20, help="test problems of a level (default: %(default)s)")
    parser.add_argument(
        "--reference", action="store_true", help="make the lengths to come up to, 30 s for each problem"
    )
    parser.add_argument("--jobs", type=one_or_more, default=1, help="runs at a time (default: one, as they are timed)")
    args = parser.parse_args()
    levels = [level for level in record.static_levels(args.levels) if level.endswith("/hard")]
    names = [name for level in levels for name in problems.frozen_names(*level.split("/"), "test")[: args.n]]
    jobs = [(name, method) for name in names for method in (("reference",) if args.reference else METHODS)]
    store = RunStore(STORE, ("problem", "method"))
    done = store.read()
    store.complete(run, [job for job in jobs if job not in done], args.jobs, warm_up)
    done = store.read()
    kept = json.loads(REFERENCE.read_text()) if REFERENCE.is_file() else {}
    if args.reference:
        made = {name: lengths[-1][1] for name, _ in jobs if (lengths := done[name, "reference"]["lengths"])}
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
    text = f"\n\n{without} of {len(names)} problems, for which aorrtc has no path after {LONG:g} s, are left out."
    limits = f"{LIMIT:g} s, within {WITHIN:g} of aorrtc's length after {LONG:g} s"
    about = {"limit": limits, **record.made_with(done[job] for job in jobs)}
    record.write("time_to_quality", {"levels": figures}, "\n".join(rows) + text, split="test", **about)


if __name__ == "__main__":
    run_script(main)
