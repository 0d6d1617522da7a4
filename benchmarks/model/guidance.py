"""Guidance by equation 7 of the paper: how many proposals of apex-paper are valid, by its scale and guided steps.

The paper gives neither. Eight proposals are made for each problem, from the same noise for every row, and proved by the
full check, on validation problems among large cubes. Runs are stored when they end, and the command resumes.

Usage: python -m benchmarks.model.guidance [-n 4] [--jobs 1]
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from apex_ompl import problems
from apex_ompl.apex.models import make_query
from apex_ompl.evaluation import Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.model.checkpoint import load_model
from apex_ompl.model.guidance import EQUATION_7, GUIDANCES, Guidance
from apex_ompl.ompl.setup import assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.path import path_length
from apex_ompl.problems.suite_robot import robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record

DEPENDS = ("@planning", "apex_ompl/model")
MODEL, COUNT = "apex-paper", 8
LEVELS = ("vertical/large", "horizontal/large")
FOLDER = record.ROOT / "benchmarks" / "runs" / "guidance"
TRIED = {0.25: (1, 16, 64, 256), 0.5: (1, 4, 16, 64, 256), 0.75: (16, 64), 1.0: (1, 16, 64)}
"""Scales, by the share of the steps at which the guidance acts."""


def row(label: str, guidance: Guidance) -> Row:
    """Return the row of a guidance."""
    params = {"scaling": guidance.scaling, "gamma": guidance.gamma, "active_below": guidance.active_below}
    return Row(label, MODEL, params, runner="benchmarks.model.guidance:proposals")


ROWS = (
    row("unguided", replace(EQUATION_7, gamma=0.0)),
    *(
        row(f"gamma {gamma}, last {share:.0%} of the steps", Guidance(gamma, "noise", active_below=share))
        for share, scales in TRIED.items() for gamma in scales
    ),
    row("on the clean path, as apex's own", GUIDANCES["clean"]),
)  # fmt: skip


def proposals(job: Job) -> Run:
    """Return how many proposals for a problem are valid, their mean length [rad], and the CPU time of all [s]."""
    torch.set_num_threads(1)
    model, ready = load_model(MODEL), assemble(problems.load(job.problem), robot())
    query = make_query(ready.checker, ready.start, ready.goals[0])
    sampling = replace(model.sampling, guidance=Guidance(**job.params))
    begin = time.process_time()
    with torch.no_grad():
        generator = np.random.default_rng(job.seed)
        made = model.propose(query, ready.checker.kernel, COUNT, sampling=sampling, generator=generator)
    took = time.process_time() - begin
    paths = [model.spline.path(control) for control in made.control]
    valid = sum(bool(full_check(ready.checker, path, ready.start, [ready.goals[0]])) for path in paths)
    length = float(np.mean([path_length(path) for path in paths]))
    return {"solved": valid > 0, "valid": valid, "total": took, "length": length}


def main() -> None:
    """Run what is missing, and write the results."""
    parser = record.parser(__doc__, n=4, jobs=1)
    args = parser.parse_args()
    results = bench(
        LEVELS, ROWS, FOLDER, runs=args.n, timeout=600.0, split="validation", workers=Workers(args.jobs),
        provenance=record.session(),
    )  # fmt: skip
    values: dict[str, Any] = {}
    lines = [record.row(["guidance", "valid", "of", "95 %", "length rad", "CPU s"]), record.row(["---", *["---:"] * 5])]
    for name in (one.label for one in ROWS):
        runs = [run for run in results.runs if run["label"] == name and run["seed"] < args.n]
        valid, count = sum(run["valid"] for run in runs), COUNT * len(runs)
        low, high = share_interval(valid, count)
        length, took = (float(np.mean([run[key] for run in runs])) for key in ("length", "total"))
        values[name] = {"valid": valid, "of": count, "interval": [low, high], "length": length, "cpu_s": took}
        cells = [f"{valid / count:.2f}", str(count), f"{low:.2f}-{high:.2f}", f"{length:.2f}", f"{took:.1f}"]
        lines.append(record.row([name, *cells]))
    about = {"split": "validation", "problems": args.n * len(LEVELS), "proposals_a_problem": COUNT}
    record.write("guidance", {"rows": values}, "\n".join(lines), **about, **record.made_with(results))


if __name__ == "__main__":
    run_script(main)
