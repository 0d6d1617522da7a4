"""Quality of proposals: B = 1, 8 and 32 of them checked, optimized, checked again and shortened, on test problems.

The models, unguided and guided, stand beside the straight line, random bumps, the nearest training paths, a regression
network of the same size, conditions and training, the same network with random weights, and with the conditions of
another problem of the level. All are optimized by the same steps of the same optimizer, shortened, and checked by
the same full check; beside them rrtconnect+polish. Times leave out the setup of the problem. Runs are kept in a store
as they end (JSON lines); the same command resumes an interrupted run.

The regression network is trained by ``python scripts/train.py scripts/configs/apex.yaml --set
denoiser.kind=regression --out benchmarks/runs/regression``, with the same --set as the model.

Usage: python benchmarks/proposals.py [SUITE[/LEVEL] ...] [-n 10] [--hard 30] [--jobs 2] [--split test] [--report]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import record
import torch
from controls import Shuffled, checkpoint_digest, digest, drawn, next_query
from neighbours import Neighbours
from proposal_tables import figures, table
from store import RunStore

from apex_ompl import load_model, plan, problems
from apex_ompl.apex.query import make_query
from apex_ompl.diffusion.checkpoint import SHIPPED, read_config
from apex_ompl.diffusion.data import shard_paths
from apex_ompl.diffusion.guidance import Guidance
from apex_ompl.diffusion.mirror import Mirror
from apex_ompl.diffusion.proposals import Sampling, TrajectoryModel
from apex_ompl.kernel import Kernel, RobotTables
from apex_ompl.kernel.scene_builder import scene_tables
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.problems.reach import robot
from apex_ompl.result import INSIDE
from apex_ompl.trajopt.candidates import first_valid
from apex_ompl.trajopt.optimizer import Optimizer
from apex_ompl.trajopt.path import path_length
from apex_ompl.util.scripts import run_command
from apex_ompl.util.validation import one_or_more, whole_number

ROOT = record.RESULTS.parent.parent
STORE = record.RESULTS.parent / "runs" / "proposals.jsonl"
COUNTS = (1, 8, 32)
GUIDED = Guidance(gamma=1.0)
PAPER = Sampling("ddpm", 256)
GUIDED_PAPER = Sampling("ddpm", 256, guidance=Guidance(1.0, "noise", active_below=0.25))
METHODS: dict[str, tuple[int, ...]] = {
    "line": (1,),
    "bumps": (8, 32),
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
    torch.set_num_threads(1)
    if name == "random weights":
        return TrajectoryModel(drawn(load_model("apex").network), {})
    if name == "shuffled conditions":
        return Shuffled(load_model("apex").network, {})
    return load_model(name)


@cache
def neighbours(data: str) -> Neighbours:
    """Return the training paths to look for neighbours in, with the mirror images that the model saw."""
    tables = RobotTables.load(ROOT / "data" / "dual_panda_softhand" / "robot.npz")
    paths, _ = shard_paths(data.split(","), 0, 10**9, 0)
    mirror = load_model("apex").about["config"]["mirror"]
    images = [] if mirror is None else [Mirror(**mirror).paths(paths, Kernel(tables, scene_tables([])))]
    return Neighbours([paths, *images], tables)


class Job(NamedTuple):
    """A run: a problem, a method, its number of proposals, and the digest of its models."""

    problem: str
    method: str
    count: int
    made_of: str
    data: str
    regression: str

    @property
    def key(self) -> tuple[str, str, int, str]:
        """The job's entries of ``KEYS``."""
        return self.problem, self.method, self.count, self.made_of


KEYS = ("problem", "method", "count", "made_of")
"""What tells runs apart."""


def made_of(method: str, args: argparse.Namespace) -> str:
    """Return a digest of the models that a method uses, so that runs of others are not taken for its own.

    Raises:
        SystemExit: The regression network was not trained as the model was.
    """
    if method in ("line", "bumps", "rrtconnect+polish"):
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


def run(job: Job) -> dict[str, Any]:
    """Return one run of a method on a problem with so many proposals."""
    name, method, count = job.problem, job.method, job.count
    seed = int(name.rsplit("/", 1)[1]) % 1000
    about = {"problem": name, "method": method, "count": count, "made_of": job.made_of}
    if method == "rrtconnect+polish":
        result = plan(problems.load(name), method, timeout=TIME_LIMIT, seed=seed)
        took = sum(result.times.get(k, 0.0) for k in ("line", "solve", "simplify", "verify", "repair"))
        found = took - sum(result.times.get(f"{INSIDE}{k}", 0.0) for k in ("simplify", "polish"))
        length = result.length if result else None
        return {**about, "sampled": False, "solved": bool(result), "found_s": found, "total_s": took, "length": length}
    ready, optimizer = assemble(problems.load(name), robot()), Optimizer()
    make = proposer(ready, optimizer, job, seed)

    def is_valid(path: np.ndarray) -> bool:
        return bool(full_check(ready.checker, path, ready.start, [ready.goals[0]]))

    begin = time.perf_counter()
    control = make(count)
    proposed = time.perf_counter()
    valid = next((c for c in control if is_valid(optimizer.spline.path(c))), None)
    checked = time.perf_counter()
    found = valid if valid is not None else first_valid(optimizer, ready.checker.kernel, control, is_valid)
    found_s = time.perf_counter() - begin
    best = None if found is None else optimizer.shorten(ready.checker.kernel, found, is_valid)
    best = found if best is None else best
    took = time.perf_counter() - begin
    length = None if best is None else path_length(optimizer.spline.path(best))
    return {
        **about, "sampled": valid is not None, "solved": best is not None, "propose_s": proposed - begin,
        "judge_s": checked - proposed, "found_s": found_s, "total_s": took, "length": length,
    }  # fmt: skip


def proposer(ready: PlanningSetup, optimizer: Optimizer, job: Job, seed: int) -> Callable[[int], np.ndarray]:
    """Return the function from a count to proposals; what does not depend on the problem is loaded here."""
    method = job.method
    kernel, start, goal = ready.checker.kernel, ready.start, ready.goals[0]
    if method in ("line", "bumps"):
        return lambda count: optimizer.starts(start, goal, count, np.random.default_rng(seed))
    if method == "nearest paths":
        near = neighbours(job.data)
        return lambda count: near.refitted(make_query(ready.checker, start, goal, point=False), kernel, count)
    kinds = {"regression": job.regression, "random weights": method, "shuffled conditions": method}
    network = model(kinds.get(method, "apex-paper" if method.startswith("apex-paper") else "apex"))
    if isinstance(network, Shuffled):
        network.other = next_query(job.problem)
    sampling = {"apex, guided": Sampling(guidance=GUIDED), "apex-paper": PAPER, "apex-paper, guided": GUIDED_PAPER}
    ready.checker.obstacle_point(start)  # GJK's pairs are made ready once for a scene

    def made(count: int) -> np.ndarray:
        query = make_query(ready.checker, start, goal, point=network.sees_point)
        generator = torch.Generator().manual_seed(seed)
        return network.propose(query, kernel, count, sampling=sampling.get(method), generator=generator).control

    return made


def warm_up(jobs: Sequence[Job]) -> None:
    """Load kernel, robot and models, so that no run pays for it: one run of each method on an easy problem."""
    for job in jobs:
        run(job._replace(problem="wall/easy/800000"))


def attempted(job: Job) -> dict[str, Any]:
    """Return a run; one that raises counts as not solved, with its error."""
    try:
        return run(job)
    except Exception as error:
        about = {"problem": job.problem, "method": job.method, "count": job.count, "made_of": job.made_of}
        return {**about, "sampled": False, "solved": False, "error": repr(error)}


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]")
    parser.add_argument("-n", type=one_or_more, default=10, help="problems of a level (default: %(default)s)")
    parser.add_argument("--hard", type=whole_number, default=30, help="of a hard level (default: %(default)s)")
    parser.add_argument(
        "--paper", type=whole_number, default=5, help="of a level for apex-paper (default: %(default)s)"
    )
    parser.add_argument(
        "--data", default=str(ROOT / "data" / "dual_panda_softhand" / "paths.zip"), help="for neighbours"
    )
    parser.add_argument("--jobs", type=one_or_more, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--methods", nargs="*", choices=list(METHODS), default=list(METHODS), metavar="NAME")
    parser.add_argument("--regression", default=str(ROOT / "benchmarks" / "runs" / "regression" / "checkpoint"))
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of what the store holds")
    args = parser.parse_args()
    chosen = record.static_levels(args.levels)
    kinds = {method: made_of(method, args) for method in args.methods}
    jobs: list[Job] = []
    for level in chosen:
        most = args.hard if level.endswith("/hard") else args.n
        names = problems.frozen_names(*level.split("/"), args.split)[:most]
        for method in args.methods:
            few = names[: args.paper] if method.startswith("apex-paper") else names
            rest = kinds[method], args.data, args.regression
            jobs += [Job(name, method, count, *rest) for count in METHODS[method] for name in few]
    store = RunStore(args.store, KEYS)
    done = store.read()
    todo = [] if args.report else [job for job in jobs if job.key not in done]
    todo.sort(key=lambda job: (job.method.startswith("apex-paper"), int(job.problem.rsplit("/", 1)[1]) % 1000))
    first = {job.method: job for job in reversed(todo)}
    store.complete(attempted, todo, args.jobs, warm_up, list(first.values()))
    done = store.read()
    runs = [done[job.key] for job in jobs if job.key in done]
    by_level = {v: [r for r in runs if r["problem"].startswith(f"{v}/")] for v in chosen}
    levels = [{"level": v, "methods": figures(by_level[v], METHODS)} for v in chosen]
    levels = [level for level in levels if level["methods"]]
    hard = [r for r in runs if "/hard/" in r["problem"]]
    if hard:
        levels.insert(0, {"level": "all hard levels", "methods": figures(hard, METHODS)})
    record.write(
        "proposals", {"levels": levels, "made_of": kinds}, table(levels), split=args.split,
        time_limit=TIME_LIMIT, seeds="number of the problem modulo 1000", **record.made_with(runs),
    )  # fmt: skip


if __name__ == "__main__":
    run_command(main)
