"""Every path of a benchmark's runs, and its timed motion, checked anew state by state at a small spacing.

The paths are those that head_to_head.py and standing.py store. Each is timed as ``plan`` times it; one that cannot be
timed is counted. States on the path and on the motion are then checked one by one by the meshes, with the sphere covers
only to sort out pairs that are far apart: no proof of this project has a part in it. Each file is one task, and what is
done is kept in benchmarks/runs/recheck, where the command resumes.

Usage: python benchmarks/recheck.py [--runs head_to_head] [--spacing 0.000155] [--motion-spacing 0.0000155] [--jobs 2]
"""

from __future__ import annotations

import argparse
import json
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import record
from tqdm import tqdm

from apex_ompl.api import load_problem
from apex_ompl.benchmark import Results
from apex_ompl.errors import TimingError
from apex_ompl.ompl_adapter.setup import PlanningSetup, assemble
from apex_ompl.ompl_adapter.validity import full_check
from apex_ompl.result import PlanResult
from apex_ompl.robot import load_robot
from apex_ompl.trajectory import Trajectory, time_path
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder
from apex_ompl.util.validation import one_or_more

DEPENDS = ("@benchmark", "apex_ompl/trajectory", "benchmarks/head_to_head.py", "benchmarks/standing.py")
RUNS = Path(__file__).parent / "runs"
SPACING = 0.0031 / 20  # a twentieth of the spacing at which paths were checked before they were proved [rad, max-norm]
MOTION_SPACING = 0.00031 / 20  # and of motions
AT_ONCE = 20_000  # states


@lru_cache(maxsize=1)
def setup_of(name: str, robot: str) -> PlanningSetup:
    """Return the planning setup of a problem; one problem is kept."""
    return assemble(load_problem(name), load_robot(robot))


def colliding(setup: PlanningSetup, states: Array) -> int:
    """Return how many states collide."""
    parts = (states[k : k + AT_ONCE] for k in range(0, len(states), AT_ONCE))
    return sum(int((~setup.checker.are_free(part)).sum()) for part in parts)


def sampled(motion: Trajectory, spacing: float) -> Array:
    """Return states on a motion, at most ``spacing`` apart by its largest velocity in each piece [rad, max-norm]."""
    times, pieces = motion.times, list[Array]()
    for a, b in zip(times[:-1], times[1:], strict=True):
        fastest = np.abs(motion(np.linspace(a, b, 9), order=1)).max() * 1.1 + 1e-9
        pieces.append(np.linspace(a, b, max(2, math.ceil((b - a) * fastest / spacing) + 1))[:-1])
    return np.asarray(motion(np.concatenate([*pieces, times[-1:]])))


def recheck(file: Path, spacing: float, motion_spacing: float) -> dict[str, Any]:
    """Return the counts of a stored path: states and how many of them collide, on the path and on its motion."""
    result = PlanResult.load(file)
    if result.path is None:
        raise SystemExit(f"{file}: expected the result of a solved run, with a path")
    setup = setup_of(result.problem.name, result.robot)
    states = result.path.sample(spacing)
    found: dict[str, Any] = {
        "file": file.name, "problem": result.problem.name, "planner": result.planner, "seed": result.seed,
        "clearance": result.clearance, "path": [len(states), colliding(setup, states)], "motion": None,
    }  # fmt: skip

    def fault(motion: Trajectory) -> str:
        return full_check(setup.checker, motion, setup.start, setup.goals).reason

    try:
        motion = time_path(result.path, setup.robot.limits, result.joint_names, fault=fault).trajectory
    except TimingError as error:
        return found | {"reason": str(error)}
    states = sampled(motion, motion_spacing)
    return found | {"motion": [len(states), colliding(setup, states)]}


def main() -> None:
    """Check what is left, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", default="head_to_head", help="folder in benchmarks/runs (default: %(default)s)")
    parser.add_argument("--spacing", type=float, default=SPACING, help="of states on paths [rad]")
    parser.add_argument("--motion-spacing", type=float, default=MOTION_SPACING, help="of states on motions [rad]")
    parser.add_argument("--jobs", type=one_or_more, default=2)
    args = parser.parse_args()
    results = Results.load(RUNS / args.runs)
    labels = {results.plan_file(run).name: run["label"] for run in results.runs if run["solved"]}
    kept = make_folder(RUNS / "recheck") / f"{args.runs}.jsonl"
    done = {row["file"]: row for row in map(json.loads, kept.read_text().splitlines())} if kept.exists() else {}
    files = sorted(
        (run["problem"], file) for run in results.runs if run["solved"] and (file := results.plan_file(run)).exists()
    )
    left = [file for _, file in files if file.name not in done]
    task = partial(recheck, spacing=args.spacing, motion_spacing=args.motion_spacing)
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool, kept.open("a") as out:
        for future in tqdm(as_completed([pool.submit(task, file) for file in left]), total=len(left), unit="path"):
            row = future.result()
            done[row["file"]] = row
            out.write(json.dumps(row) + "\n")
            out.flush()
    rows = [{**done[file.name], "label": labels[file.name]} for _, file in files]
    table, bad = [], [r for r in rows if any(r[kind] and r[kind][1] for kind in ("path", "motion"))]
    for label in ("all", *dict.fromkeys(labels.values())):
        mine = [r for r in rows if label in ("all", r["label"])]
        paths, motions = ([r[kind] for r in mine if r[kind]] for kind in ("path", "motion"))
        if paths:
            table.append([
                label, len(paths), sum(n for n, _ in paths), sum(bad > 0 for _, bad in paths), len(motions),
                sum(n for n, _ in motions), sum(bad > 0 for _, bad in motions),
            ])  # fmt: skip
    head = ["planner", "paths", "states on them", "paths that collide", "timed motions", "states on them",
            "motions that collide"]  # fmt: skip
    text = "\n".join(record.row(r) for r in [head, ["---"] + ["---:"] * 6, *table])
    text += f"\n\nPaths of solved runs that were not stored: {len(labels) - len(files)}."
    text += "".join(f"\n\nCollides: {r['label']} on {r['problem']}, seed {r['seed']}." for r in bad)
    about = {"spacing": f"{args.spacing:g} rad", "motion_spacing": f"{args.motion_spacing:g} rad"}
    record.write("recheck", {"table": {"head": head, "rows": table}, "colliding": bad}, text, **about)


if __name__ == "__main__":
    run_script(main)
