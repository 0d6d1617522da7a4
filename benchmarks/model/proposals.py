"""What proposals are worth: B = 1, 8 and 32 of them checked, repaired, checked again and shortened, on test problems.

The models, unguided and guided, stand beside the straight line, random perturbations, the nearest training paths, a
regression network of the same size, conditions and training, the same network with random weights, and with the
conditions of another problem of the level. All are repaired by the same steps of the same optimizer, shortened, and
pass the same full check; beside them rrtconnect+polish, whose trees have the tuned range. Times leave out the setup of
the problem. Each run is stored in benchmarks/runs/proposals when it ends; the command resumes where it was stopped.
Runs with other models or data need another folder.

The regression network is trained by ``python scripts/train.py scripts/configs/apex.yaml --set
denoiser.kind=regression --out benchmarks/runs/regression``, with the same --set as the model.

Usage: python -m benchmarks.model.proposals [SUITE[/LEVEL] ...] [-n 10] [--hard 30] [--jobs 2] [--split test] [--report]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import load_model
from apex_ompl.apex.models import make_query
from apex_ompl.evaluation import Results, Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import NO_PROBLEM, Run
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.model.checkpoint import SHIPPED, read_config
from apex_ompl.model.guidance import EQUATION_7, Guidance
from apex_ompl.model.proposals import Sampling, TrajectoryModel
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.paths.candidates import first_valid
from apex_ompl.paths.optimizer import Optimizer
from apex_ompl.paths.path import path_length
from apex_ompl.problems import load
from apex_ompl.problems.suite_robot import robot
from apex_ompl.training.data import Mirror, shard_paths
from apex_ompl.training.torch_model import load_torch_model
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import whole_number
from benchmarks.lib import record
from benchmarks.lib.controls import Neighbors, Shuffled, checkpoint_digest, digest, drawn, next_query

ROOT = record.ROOT
FOLDER = record.RESULTS.parent / "runs" / "proposals"
DEPENDS = ("@benchmark", "benchmarks/lib/controls.py")
COUNTS = (1, 8, 32)
GUIDED = Guidance(gamma=1.0)
PAPER = Sampling("ddpm", 256)
GUIDED_PAPER = Sampling("ddpm", 256, guidance=EQUATION_7)
METHODS: dict[str, tuple[int, ...]] = {
    "line": (1,),
    "perturbations": (8, 32),
    "nearest paths": COUNTS,
    "regression": (1,),
    "random weights": COUNTS,
    "shuffled conditions": COUNTS,
    "apex": COUNTS,
    "apex, guided": COUNTS,
    "apex-paper": COUNTS,
    "apex-paper, guided": COUNTS,
    "rrtconnect+polish": (1,),
}
"""And with how many proposals."""

TIME_LIMIT = 10.0  # of rrtconnect+polish [s]


@cache
def model(name: str) -> TrajectoryModel:
    """Return a model by its name, folder or kind."""
    if name == "random weights":
        return drawn(load_torch_model("apex").network)
    if name == "shuffled conditions":
        apex = load_model("apex")
        return Shuffled(apex.config, apex.weights, {})
    return load_model(name)


@cache
def neighbors(data: str) -> Neighbors:
    """Return the training paths to look for neighbors in, with the mirror images that the model saw."""
    tables = RobotTables.load(ROOT / "data" / "dual_panda_softhand" / "robot.npz")
    paths, _ = shard_paths(data.split(","), 0, 10**9, 0)
    mirror = load_model("apex").about["config"]["mirror"]
    images = [] if mirror is None else [Mirror(**mirror).paths(paths, Kernel(tables, scene_tables([])))]
    return Neighbors([paths, *images], tables)


def made_of(method: str, args: argparse.Namespace) -> str:
    """Return a digest of the models that a method uses, so that runs of others are not taken for its own.

    Raises:
        SystemExit: The regression network was not trained as the model was.
    """
    if method in ("line", "perturbations", "rrtconnect+polish"):
        return ""
    if method == "nearest paths":
        return digest(*map(Path, args.data.split(",")))
    folder = (
        Path(args.regression) if method == "regression" else SHIPPED / ("apex-paper" if "paper" in method else "apex")
    )
    if method == "regression":
        mine, apex = (read_config(f).trained["config"] for f in (folder, SHIPPED / "apex"))
        mine["denoiser"]["kind"] = apex["denoiser"]["kind"]
        if any(mine[key] != apex[key] for key in ALIKE):
            raise SystemExit(f"{folder}: expected a regression that was trained as apex was")
    return checkpoint_digest(folder)


ALIKE = ("latent", "condition", "denoiser", "steps", "batch", "rate", "weights", "mirror")


def label(method: str, count: int) -> str:
    """Return the label of a row."""
    return f"{method}, {count}" if len(METHODS[method]) > 1 else method


def rows(args: argparse.Namespace) -> list[Row]:
    """Return a row of each method and number of proposals."""
    found = []
    for method in args.methods:
        if method == "rrtconnect+polish":
            found.append(Row(method, method))
            continue
        most = args.paper if method.startswith("apex-paper") else None
        if most == 0:
            continue
        about = {"made_of": made_of(method, args), "data": args.data, "regression": args.regression}
        found += [
            Row(
                label(method, count),
                method,
                {"count": count, **about},
                runs=most,
                runner="benchmarks.model.proposals:propose",
            )
            for count in METHODS[method]
        ]
    return found


def propose(job: Job) -> Run:
    """Return the columns of a run of a method; ``sampled`` is whether a proposal was valid as it was."""
    ready, optimizer = assemble(load(job.problem), robot()), Optimizer()
    make = proposer(ready, optimizer, job)

    def is_valid(path: np.ndarray) -> bool:
        return bool(full_check(ready.checker, path, ready.start, [ready.goals[0]]))

    begin = time.perf_counter()
    control = make(job.params["count"])
    proposed = time.perf_counter()
    valid = next((c for c in control if is_valid(optimizer.spline.path(c))), None)
    checked = time.perf_counter()
    found = valid if valid is not None else first_valid(optimizer, ready.checker.kernel, control, is_valid)
    first = time.perf_counter() - begin
    best = None if found is None else optimizer.shorten(ready.checker.kernel, found, is_valid)
    best = found if best is None else best
    total = time.perf_counter() - begin
    return {
        "solved": best is not None, "sampled": valid is not None, "first": None if best is None else first,
        "total": total, "times": {"propose": proposed - begin, "check": checked - proposed},
        "length": None if best is None else path_length(optimizer.spline.path(best)),
    }  # fmt: skip


def proposer(ready: PlanningSetup, optimizer: Optimizer, job: Job) -> Callable[[int], np.ndarray]:
    """Return the function that makes proposals; what does not depend on the problem is loaded before."""
    method, seed = job.planner, job.seed
    kernel, start, goal = ready.checker.kernel, ready.start, ready.goals[0]
    if method in ("line", "perturbations"):
        return lambda count: optimizer.starts(start, goal, count, np.random.default_rng(seed))
    if method == "nearest paths":
        near = neighbors(job.params["data"])
        return lambda count: near.refitted(make_query(ready.checker, start, goal, point=False), kernel, count)
    kinds = {"regression": job.params["regression"], "random weights": method, "shuffled conditions": method}
    network = model(kinds.get(method, "apex-paper" if method.startswith("apex-paper") else "apex"))
    if isinstance(network, Shuffled):
        network.other = next_query(job.problem)
    sampling = {"apex, guided": Sampling(guidance=GUIDED), "apex-paper": PAPER, "apex-paper, guided": GUIDED_PAPER}
    ready.checker.obstacle_point(start)  # GJK's pairs are made ready once for a scene

    def made(count: int) -> np.ndarray:
        query = make_query(ready.checker, start, goal, point=network.sees_point)
        generator = np.random.default_rng(seed)
        return network.propose(query, kernel, count, sampling=sampling.get(method), generator=generator).control

    return made


def summaries(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the statistics of every method and count on a level."""
    polished = {run["problem"]: run for run in runs if run["label"] == "rrtconnect+polish" and run["solved"]}
    labels = [label(method, count) for method, counts in METHODS.items() for count in counts]
    by_label = {name: [run for run in runs if run["label"] == name] for name in labels}
    return {name: _summary(some, polished) for name, some in by_label.items() if some}


def _summary(some: Sequence[Run], polished: dict[str, Run]) -> dict[str, Any]:
    total, first = ([run[key] if run["solved"] else math.inf for run in some] for key in ("total", "first"))
    both = [(run, polished[run["problem"]]) for run in some if run["solved"] and run["problem"] in polished]
    return {
        "n": len(some), "sampled": float(np.mean([run.get("sampled", False) for run in some])),
        "solved": float(np.mean([run["solved"] for run in some])),
        "propose_s_p50": float(np.median([run["times"].get("propose", math.nan) for run in some])),
        "found_s_p50": record.reached(first, 50), "total_s_p50": record.reached(total, 50), "both": len(both),
        "length_p50": float(np.median([run["length"] for run in some if run["solved"]] or [math.nan])),
        "length_over_polished": _mean_ratio(both, "length"), "time_over_polished": _mean_ratio(both, "total"),
    }  # fmt: skip


def _mean_ratio(pairs: Sequence[tuple[Run, Run]], key: str) -> float | None:
    """Return the geometric mean of the ratios of a column."""
    return float(np.exp(np.mean([math.log(a[key] / b[key]) for a, b in pairs]))) if pairs else None


def table(levels: Sequence[dict[str, Any]]) -> str:
    """Return the Markdown table."""
    head = ["suite/level", "proposals", "N", "valid", "repaired", "propose ms", "found ms p50", "shortened ms p50"]
    head += ["length rad", "length / rrtconnect+polish", "time / rrtconnect+polish", "on"]
    rows = [head, ["---", "---", *["---:"] * (len(head) - 2)]]
    for level in levels:
        for k, (method, f) in enumerate(level["methods"].items()):
            cells = [level["level"] if k == 0 else "", method, f["n"], f"{f['sampled']:.2f}", f"{f['solved']:.2f}"]
            cells += list(_cells(f))
            rows.append(cells)
    return "\n".join(record.row(row) for row in rows)


def _cells(f: dict[str, Any]) -> Iterator[str]:
    def ms(value: float | None, otherwise: str) -> str:
        return otherwise if value is None or math.isnan(value) else f"{1e3 * value:.0f}"

    yield ms(f["propose_s_p50"], "-")
    yield ms(f["found_s_p50"], "not found")
    yield ms(f["total_s_p50"], "not found")
    yield "-" if math.isnan(f["length_p50"]) else f"{f['length_p50']:.1f}"
    for name in ("length_over_polished", "time_over_polished"):
        yield "-" if f[name] is None else f"{f[name]:.2f}"
    yield str(f["both"])


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = record.parser(__doc__, n=10, jobs=2)
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("--hard", type=whole_number, default=30, help="of a hard level (default: %(default)s)")
    parser.add_argument(
        "--paper", type=whole_number, default=5, help="of a level for apex-paper (default: %(default)s)"
    )
    parser.add_argument(
        "--data", default=str(ROOT / "data" / "dual_panda_softhand" / "paths.zip"), help="for neighbors"
    )
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--methods", nargs="*", choices=list(METHODS), default=list(METHODS), metavar="NAME")
    parser.add_argument("--regression", default=str(ROOT / "benchmarks" / "runs" / "regression" / "checkpoint"))
    parser.add_argument("--store", type=Path, default=FOLDER, help="folder of the runs")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    args = parser.parse_args()
    chosen, wanted = record.static_levels(args.levels), rows(args)
    if not args.report:
        for count, levels in ((args.n, [v for v in chosen if not v.endswith("/hard")]),
                              (args.hard, [v for v in chosen if v.endswith("/hard")])):  # fmt: skip
            if count and levels:
                bench(levels, wanted, args.store, runs=count, timeout=TIME_LIMIT, split=args.split,
                      workers=Workers(args.jobs), provenance=record.session())  # fmt: skip
    results = Results.load(args.store)
    most = {level: args.hard if level.endswith("/hard") else args.n for level in chosen}
    labels = {row.label: row.runs or math.inf for row in wanted}
    runs = [
        run for run in results.runs
        if run["seed"] < min(most.get(run["experiment"], 0), labels.get(run["label"], 0))
        and run["status"] != NO_PROBLEM
    ]  # fmt: skip
    levels = [{"level": v, "methods": summaries([r for r in runs if r["experiment"] == v])} for v in chosen]
    levels = [level for level in levels if level["methods"]]
    hard = [run for run in runs if run["experiment"].endswith("/hard")]
    if hard:
        levels.insert(0, {"level": "all hard levels", "methods": summaries(hard)})
    kinds = {row.planner: row.params.get("made_of", "") for row in wanted}
    record.write(
        "proposals", {"levels": levels, "made_of": kinds}, table(levels), split=args.split, time_limit=TIME_LIMIT,
        seeds="number of the problem modulo 1000", **record.made_with(replace(results, runs=runs)),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
