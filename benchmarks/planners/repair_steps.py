"""How much repair proposals need on scenes of kinds that no training data are of: steps of the optimizer, no times.

Four proposals of each model are checked as they are, and then repaired, the most promising one first, as the planner
does, for at most 192 steps in all. Beside the checkpoint that ships stand the planner's random perturbations, the same
network with random weights, and checkpoints by their folders, each under its digest. Problems that the straight line's
repair solves are told apart. Planners and trainings are tuned on the first 16 problems of a level; --first 0 -n 16
takes these.
Each run is stored in benchmarks/runs/repair_steps when it ends; the command resumes where it was stopped.

Usage: python -m benchmarks.planners.repair_steps [FOLDER ...] [-n 34] [--first 16] [--jobs 2] [--report]
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.apex.model_search import NONE
from apex_ompl.apex.models import Model, make_query, trajectory_model
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run
from apex_ompl.model.checkpoint import SHIPPED, read_config
from apex_ompl.ompl.setup import assemble
from apex_ompl.paths.candidates import CandidatePool
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import FINE_RESOLUTION, path_length
from apex_ompl.problems.catalogue import VALIDATION
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.torch_model import load_torch_model
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from apex_ompl.util.validation import one_or_more, whole_number
from benchmarks.lib import record
from benchmarks.lib.controls import checkpoint_digest, drawn
from benchmarks.planners.unseen import FROZEN, SUITE, TUNED_ON

DEPENDS = ("@planning", "benchmarks/lib/controls.py", "benchmarks/planners/unseen.py")
FOLDER = record.RESULTS.parent / "runs" / "repair_steps"
COUNT = 4  # proposals, as the planner's first batch has
MOST = 48 * COUNT  # steps of repair, all that a candidate may have
WITHIN = (8, 16, 64, MOST)
LINE, PERTURBED, RANDOM = "straight line", "perturbations", "random weights"


@cache
def model(name: str) -> Model:
    """Return a model by its name, folder or kind."""
    return drawn(load_torch_model("apex").network) if name == RANDOM else trajectory_model(name, robot())


def row(label: str, name: str, digest: str = "") -> Row:
    """Return the row of a model."""
    return Row(label, label, {"model": name, "digest": digest}, runner="benchmarks.planners.repair_steps:repaired")


def rows(folders: Sequence[Path]) -> list[Row]:
    """Return the row of every model.

    Raises:
        ApexError: A checkpoint cannot be read.
    """
    apex = checkpoint_digest(SHIPPED / "apex")
    found = [row(LINE, LINE), row("apex", "apex", apex), row(RANDOM, RANDOM, apex), row(PERTURBED, NONE)]
    for folder in folders:
        read_config(folder)
        digest = checkpoint_digest(folder)
        found.append(row(f"{folder.name} {digest}", str(folder.resolve()), digest))
    return found


def repaired(job: Job) -> Run:
    """Return whether a proposal is valid as it is, and the steps of repair until one is."""
    optimizer, ready = Optimizer(), assemble(problems.load(job.problem), robot())
    kernel, start, goal = ready.checker.kernel, ready.start, ready.goals[0]
    name, generator = job.params["model"], np.random.default_rng(job.seed)
    if name == LINE:
        control = optimizer.starts(start, goal, 1, generator)
    else:
        query = make_query(ready.checker, start, goal, point=False)
        control = model(name).propose(query, kernel, COUNT, generator=generator).control
    pool = CandidatePool(optimizer, kernel, lambda path: bool(kernel.proves(path, FINE_RESOLUTION)))
    found = pool.add(control)
    sampled = found is not None
    found = found or pool.improve(MOST)
    length = None if found is None else path_length(optimizer.spline.path(found.control))
    return {"solved": found is not None, "sampled": sampled, "steps": pool.steps, "length": length}


def summary(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the statistics of a model on some problems."""
    steps = np.array([run["steps"] if run["solved"] else np.inf for run in runs])
    lengths = [run["length"] for run in runs if run["solved"]]
    return {
        "n": len(runs), "sampled": float(np.mean([run["sampled"] for run in runs])),
        "within": {str(most): float(np.mean(steps <= most)) for most in WITHIN},
        "interval": list(share_interval(int((steps <= MOST).sum()), len(runs))),
        "steps_p50": record.reached(steps, 50), "length_p50": float(np.median(lengths)) if lengths else None,
    }  # fmt: skip


def table(groups: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the Markdown table."""
    head = ["problems", "proposals", "N", "valid as sampled", *(f"in {most} steps" for most in WITHIN)]
    head += ["95 %, Wilson", "steps p50", "length rad p50"]
    lines = [record.row(head), record.row(["---", "---", *["---:"] * (len(head) - 2)])]
    for group, found in groups.items():
        for name, f in found.items():
            low, high = f["interval"]
            cells = [f"{f['sampled']:.3f}", *(f"{share:.3f}" for share in f["within"].values())]
            cells += [f"{low:.3f} to {high:.3f}", "-" if f["steps_p50"] is None else f"{f['steps_p50']:.0f}"]
            cells += ["-" if f["length_p50"] is None else f"{f['length_p50']:.1f}"]
            lines.append(record.row([group, name, f["n"], *cells]))
    return "\n".join(lines)


def main() -> None:
    """Run what is missing, and write the table."""
    parser = record.parser(__doc__, jobs=2)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", help="checkpoints beside the one that ships")
    parser.add_argument(
        "-n", type=one_or_more, default=FROZEN - TUNED_ON, help="problems of a level (default: %(default)s)"
    )
    parser.add_argument("--first", type=whole_number, default=TUNED_ON, help="left out before (default: %(default)s)")
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    if args.first + args.n > FROZEN:
        parser.error(f"expected --first and -n of {FROZEN} at most together")
    levels, wanted = [f"{SUITE}/{level}" for level in VALIDATION[SUITE]], rows(args.folders)
    if not args.report:
        bench(
            levels, wanted, args.store, runs=args.n, first=args.first, timeout=60.0, split="validation",
            workers=Workers(args.jobs), provenance=record.session(),
        )  # fmt: skip
    results, seeds = Results.load(args.store), range(args.first, args.first + args.n)
    digests = {row.label: row.params["digest"] for row in wanted}
    runs = [run for run in results.runs if run["label"] in digests and run["seed"] in seeds]
    easy = {run["problem"] for run in runs if run["label"] == LINE and run["solved"]}
    groups = {
        "all": runs,
        "those that the straight line's repair fails on": [r for r in runs if r["problem"] not in easy],
    }
    found = {
        group: {label: summary(mine) for label in digests if (mine := [r for r in some if r["label"] == label])}
        for group, some in groups.items()
    }
    about = {"proposals": COUNT, "seeds": f"{seeds[0]} to {seeds[-1]}", "checkpoints": digests}
    record.write(
        "repair_steps", {"groups": found}, table(found), split="validation", **about, **record.made_with(results)
    )


if __name__ == "__main__":
    run_script(main)
