"""Planners on every ready-made problem and on Baxter, with the checker in two stages and with its meshes alone.

Both checkers plan with the same seeds, so the searches are the same as far as the clock lets them. ``search`` is the
time of the planner, ``all work`` that of planner, simplification, full check and repair. The straight line is not tried
before the planner. Each run is stored in benchmarks/runs/shipped_problems when it ends; the command resumes where it
was stopped.

Usage: python -m benchmarks.planners.shipped_problems [--planner rrtconnect] [--seeds 20] [--timeout 10]
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any
from unittest import mock

import numpy as np

from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.evaluation import Row, Workers, bench, runs
from apex_ompl.evaluation.results import short
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.ompl import setup
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@benchmark", "examples/baxter_table.yaml")
BAXTER = record.ROOT / "examples" / "baxter_table.yaml"
FOLDER = record.RESULTS.parent / "runs" / "shipped_problems"
CHECKERS = {"two stages": True, "meshes": False}
"""Whether spheres prove motions free before meshes are asked, by name."""
TIMES = {"search": "search", "all": "all work"}
RUNNER = "benchmarks.planners.shipped_problems:plan_with_checker"


def plan_with_checker(job: Job) -> Run:
    """Return the columns of a run with one of the checkers; ``path`` is a digest of the path."""
    checker = partial(CollisionChecker, proofs=job.params["proofs"])
    with mock.patch.object(setup, "CollisionChecker", checker):
        planning, experiment, result = runs.planned(replace(job, params={}, runner=""))
        found = runs.columns(planning, experiment, result)
    return {
        **found,
        "path": "" if result.path is None else hashlib.sha256(result.path.states.tobytes()).hexdigest()[:16],
    }


def label(planner: str, checker: str) -> str:
    """Return the label of a row."""
    return f"{planner}, {checker}"


def statistics(planner: str, problem: str, made: Sequence[Run]) -> dict[str, Any]:
    """Return the statistics of a planner on a problem with both checkers; times in ms."""
    by = {name: {r["seed"]: r for r in made if r["label"] == label(planner, name)} for name in CHECKERS}
    two, meshes = ({seed: run.get("path") for seed, run in some.items()} for some in by.values())
    solved = {name: [run for run in some.values() if run["solved"]] for name, some in by.items()}
    proven = solved["two stages"]
    return {
        "planner": planner, "problem": problem,
        "same_path": sum(bool(path) and path == meshes[seed] for seed, path in two.items()),
        "passed_first_time": [sum(run["by"] == planner for run in proven), len(proven)],
        "search": {name: [1e3 * run["times"]["solve"] for run in some] for name, some in solved.items()},
        "all": {name: [1e3 * run["total"] for run in some] for name, some in solved.items()},
        "length_rad": float(np.median([run["length"] for run in proven])) if proven else None,
        "checks": float(np.median([run["checks"] for run in proven])) if proven else None,
    }  # fmt: skip


def table(found: Sequence[dict[str, Any]], count: int) -> str:
    """Return the Markdown table of problems, of ``count`` runs with each checker, and all problems of each planner."""
    head = ["planner", "problem", "exact, two stages", "meshes", "same path", "passed the full check the first time"]
    for what in TIMES.values():
        head += [f"{what}, meshes ms p50", "p95", "two stages p50", "p95", "ratio p50", "p95"]
    lines = [[*head, "length rad p50", "checks p50"], ["---", "---", *["---:"] * len(head)]]
    for f in found:
        passed, of = f["passed_first_time"]
        cells = [f["planner"], f["problem"], *(f"{len(f['all'][name])}/{count}" for name in CHECKERS), f["same_path"]]
        rest = [f"{f[key]:{style}}" if f[key] else "-" for key, style in (("length_rad", ".1f"), ("checks", ".0f"))]
        lines.append([*cells, f"{passed}/{of}", *(c for what in TIMES for c in _times(f[what])), *rest])
    for planner in dict.fromkeys(f["planner"] for f in found):
        mine = [f for f in found if f["planner"] == planner]
        pooled = {what: {name: [t for f in mine for t in f[what][name]] for name in CHECKERS} for what in TIMES}
        times = [cell for what in TIMES for cell in _times(pooled[what])]
        lines.append([planner, "all of them", "", "", "", "", *times, "", ""])
    return "\n".join(record.row(line) for line in lines)


def _times(values: dict[str, list[float]]) -> list[str]:
    meshes, two = (np.array(record.percentiles(values[name], 50, 95)) for name in ("meshes", "two stages"))
    return [f"{v:.1f}" for v in (*meshes, *two, *(meshes / two))]


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__)
    parser.add_argument("--planner", action="append", default=[])
    parser.add_argument("--seeds", type=one_or_more, default=20, help="runs on a problem (default: %(default)s)")
    parser.add_argument("--timeout", type=float, default=10.0)
    args = parser.parse_args()
    planners = args.planner or ["rrtconnect"]
    rows = [
        Row(label(planner, name), planner, {"proofs": proofs}, runner=RUNNER)
        for planner in planners for name, proofs in CHECKERS.items()
    ]  # fmt: skip
    names = [*problems.names(), str(BAXTER)]
    results = bench(
        names, rows, FOLDER, runs=args.seeds, timeout=args.timeout, workers=Workers(), provenance=record.session()
    )
    results = replace(results, runs=[run for run in results.runs if run["seed"] < args.seeds])
    found = [
        statistics(planner, short(name), [run for run in results.runs if run["problem"] == name])
        for planner in planners for name in names
    ]  # fmt: skip
    record.write(
        "shipped_problems", {"problems": found}, table(found, args.seeds), seeds=f"0-{args.seeds - 1}", N=args.seeds,
        timeout=args.timeout, **record.made_with(results),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
