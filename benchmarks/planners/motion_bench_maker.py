"""VAMP and RoboPlan beside apex and rrtconnect on MotionBenchMaker's problems of Baxter with both arms at a bookshelf.

The problems (Chamzas et al. 2022) are those that VAMP's source package ships, ``resources/baxter/problems.tar.bz2``
unpacked: ``pip download --no-binary :all: --no-deps vamp-planner``. Baxter's fingers are as far open as the problems
say. No model ships for Baxter: random perturbations take the place of apex's proposals. VAMP (Thomason, Kingston and
Kavraki 2024) checks spheres and capsules of its own in single precision, and has no time limit but a number of
iterations; RoboPlan checks the meshes. Whatever they find is looked at by the full check here, with the real meshes and
the limits, and repaired where it fails, as rrtconnect's paths are: ``own`` is the share that a planner solves by its
own check, ``failed at first`` counts paths that failed the full one. The last line says how often VAMP's check and this
one agree on random states near starts and goals. Each run is stored in benchmarks/runs/motion_bench_maker when it ends;
the command resumes where it was stopped.

Usage: python -m benchmarks.planners.motion_bench_maker FOLDER [-n 30] [--jobs 1]    (needs the extra "peers")
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.api import load_problem
from apex_ompl.errors import MissingFileError
from apex_ompl.evaluation import Row, Workers, bench
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import Run, first_path_proof
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.paths.path import path_length
from apex_ompl.robot import load_robot
from apex_ompl.robot.moveit import convert
from apex_ompl.util.clocks import Deadline
from apex_ompl.util.entry_point import run_script
from benchmarks.lib import record, vamp_world
from benchmarks.lib.full_check import proved_or_repaired
from benchmarks.planners import peers
from benchmarks.robots.fleet import open_baxter

vamp = vamp_world.library()
DEPENDS = (
    "@benchmark",
    "benchmarks/planners/peers.py",
    "benchmarks/lib/vamp_world.py",
    "apex_ompl/goals",
    "apex_ompl/robot/data/baxter.robot.yaml",
)
FOLDER = Path(__file__).parents[1] / "runs" / "motion_bench_maker"
SETS = ("easy", "medium", "hard")
RUNNER = "benchmarks.planners.motion_bench_maker:plan_with_vamp"
ROWS = (
    Row("apex", "apex"),
    Row("apex without proposals", "apex", {"first": 0, "second": 0, "third": 0, "resample": 0}),
    Row("rrtconnect", "rrtconnect"),
    Row.of("rrtconnect", TUNED["rrtconnect"]),
    Row("rrtconnect+polish", "rrtconnect+polish"),
    Row("roboplan", "roboplan", runner=peers.RUNNER),
    Row.of("roboplan", TUNED["roboplan"], runner=peers.RUNNER),
    Row("vamp", "vamp", runner=RUNNER),
    Row.of("vamp", {"dynamic_domain": False}, runner=RUNNER),
)


def agreement(ready: PlanningSetup, made: Any, rng: np.random.Generator) -> list[int]:
    """Return the numbers of random states: free to both, colliding, free to VAMP alone, to the checker alone."""
    ends, limits = np.stack([ready.start, ready.goals[0]]), ready.robot.limits
    states = ends[rng.integers(2, size=peers.STATES)] + rng.normal(0.0, 0.3, (peers.STATES, ready.robot.dof))
    states = np.clip(states, limits.lower, limits.upper)
    ours, theirs = ready.checker.are_free(states), [vamp.baxter.validate(q.astype(np.float32), made) for q in states]
    pairs = [(True, True), (False, False), (True, False), (False, True)]
    return [sum(pair == (t, o) for t, o in zip(theirs, ours.tolist(), strict=True)) for pair in pairs]


def plan_with_vamp(job: Job) -> Run:
    """Return the columns of a run of VAMP; ``own`` is whether it found a path by its own check.

    Parameters of the job are those of its ``RRTCSettings``, whose defaults hold otherwise.
    """
    problem = load_problem(job.problem)
    ready, made = assemble(problem), vamp_world.environment(problem)
    same = agreement(ready, made, np.random.default_rng(job.seed))
    deadline, times = Deadline(job.timeout), dict[str, float]()
    candidates = vamp_world.planned(
        "baxter", (ready.start, ready.goals[0]), ready.robot.joint_names, made, times, seed=job.seed, **job.params
    )
    if not candidates:
        return {"solved": False, "reason": "VAMP found no path", "times": times, "own": False, "agreement": same}
    path, reason = proved_or_repaired(ready, candidates, deadline.at, times)
    first = times["solve"] + first_path_proof(ready.checker, candidates[-1], ready.start, ready.goals, times)
    return {
        "solved": path is not None, "first": first if path is not None else None, "total": sum(times.values()),
        "times": times, "length": None if path is None else path_length(path), "reason": reason, "own": True,
        "agreement": same,
    }  # fmt: skip


def converted(folder: Path, count: int) -> list[Path]:
    """Return problem files of the first requests of each set, which are made where they are missing."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    place = open_baxter(FOLDER / "baxter_open.robot.yaml")
    robot, files = load_robot(place), list[Path]()
    for kind in SETS:
        there = sorted(folder.rglob(f"bookshelf_tall_both_arms_{kind}_baxter/request*.yaml"))[:count]
        if not there:
            raise MissingFileError(
                str(folder), "folder of problems", f"no bookshelf_tall_both_arms_{kind}_baxter in it"
            )
        for request in there:
            problem = convert(request.with_name(request.name.replace("request", "scene")), request, robot).problem
            name = f"{kind}_{request.stem.removeprefix('request')}"
            files.append(FOLDER / f"{name}.yaml")
            problem.model_copy(update={"name": name, "robot": str(place)}).save(files[-1])
    return files


def tabulate(runs: Sequence[Run]) -> tuple[dict[str, Any], str]:
    """Return the statistics of each row on each set, and on all, and a Markdown table of them."""
    head = ["problems", "planner", "N", "own", "solved", "failed at first", "first ms p50", "p95", "end ms p50", "p95"]
    lines = [record.row([*head, "length rad"]), record.row(["---", "---", *["---:"] * (len(head) - 1)])]
    found: dict[str, Any] = {}
    for kind in (*SETS, "all"):
        for k, row in enumerate(ROWS):
            some = [r for r in runs if r["label"] == row.label and Path(r["problem"]).name.startswith(f"{kind}_")]
            some = [r for r in runs if r["label"] == row.label] if kind == "all" else some
            if not some:
                continue
            f = found[f"{kind}, {row.label}"] = peers.summary(some)
            f["own"] = float(np.mean([run.get("own", run["solved"]) for run in some]))
            times = ["-" if v is None else f"{1e3 * v:.1f}" for v in (*f["first_s"], *f["total_s"])]
            length = "-" if f["length"] is None else f"{f['length']:.1f}"
            shares = f"{f['own']:.2f}", f"{f['solved']:.2f}", f["failed_check"]
            lines.append(record.row([kind if k == 0 else "", row.label, f["n"], *shares, *times, length]))
    return found, "\n".join(lines)


def main() -> None:
    """Run what is missing, and write the results of all."""
    parser = record.parser(__doc__, n=30, of="problems of each set", jobs=1)
    parser.add_argument("folder", type=Path, help="the unpacked problems")
    args = parser.parse_args()
    files = converted(args.folder, args.n)
    results = bench(
        [str(file) for file in files], ROWS, FOLDER / "runs", runs=1, timeout=peers.TIMEOUT,
        workers=Workers(args.jobs, modules=("peers", "motion_bench_maker")), provenance=record.session(),
    )  # fmt: skip
    wanted = {str(file) for file in files}
    found, table = tabulate([run for run in results.runs if run["problem"] in wanted])
    same = found["all, vamp"]["agreement"]
    words = "both free, both colliding, free to VAMP alone, free to the checker alone"
    table += f"\n\nRandom states near starts and goals: {', '.join(map(str, same))} ({words})."
    record.write(
        "motion_bench_maker", {"rows": found}, table, limit=f"{peers.TIMEOUT:g} s", roboplan=version("roboplan"),
        vamp=version("vamp-planner"), **record.made_with(results),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
