"""Every path of a benchmark's runs, and its timed motion, checked anew state by state at a small spacing.

The paths are those that head_to_head.py and standing.py store. Each is timed as ``plan`` times it; one that cannot be
timed is counted. States on the path and on the motion are then checked one by one by the meshes, with the sphere covers
only to sort out pairs that are far apart: no proof of this project has a part in it. Each path is one task, and what
is done is kept in benchmarks/runs/recheck by a digest of the path and the spacings, so that the command resumes and a
path that a later run finds again, bit for bit, is not checked again.

Usage: python -m benchmarks.collision.recheck [--runs head_to_head] [--spacing 0.000155] [--motion-spacing 0.0000155]
    [--jobs 2]
"""

from __future__ import annotations

import hashlib
import json
import math
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from apex_ompl.api import load_problem
from apex_ompl.errors import TimingError
from apex_ompl.evaluation import Results
from apex_ompl.ompl.setup import PlanningSetup, assemble
from apex_ompl.ompl.validity import full_check
from apex_ompl.result import PlanResult
from apex_ompl.robot import load_robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder
from apex_ompl.util.validation import positive_number
from benchmarks.lib import record

DEPENDS = ("@benchmark", "apex_ompl/timing", "benchmarks/planners/head_to_head.py", "benchmarks/planners/standing.py")
RUNS = Path(__file__).parents[1] / "runs"
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


def digest(result: PlanResult, spacings: tuple[float, float]) -> str:
    """Return a digest of what is checked: problem, robot, joints, path and spacings."""
    path, query = result.path, (result.problem.name, result.robot, result.joint_names, spacings)
    arrays = (path.states, *(() if path.control is None else (path.control,)))
    return hashlib.sha256(repr(query).encode() + b"".join(a.tobytes() for a in arrays)).hexdigest()[:16]


def digest_of(file: Path, spacings: tuple[float, float]) -> str:
    """Return the digest of a stored result.

    Raises:
        SystemExit: It has no path.
    """
    result = PlanResult.load(file)
    if result.path is None:
        raise SystemExit(f"{file}: expected the result of a solved run, with a path")
    return digest(result, spacings)


def recheck(file: Path, spacings: tuple[float, float]) -> dict[str, Any]:
    """Return the counts of a stored path: states and how many of them collide, on the path and on its motion."""
    result = PlanResult.load(file)
    setup = setup_of(result.problem.name, result.robot)
    states = result.path.sample(spacings[0])
    found: dict[str, Any] = {
        "digest": digest(result, spacings), "problem": result.problem.name, "clearance": result.clearance,
        "path": [len(states), colliding(setup, states)], "motion": None,
    }  # fmt: skip

    def fault(motion: Trajectory) -> str:
        return full_check(setup.checker, motion, setup.start, setup.goals).reason

    try:
        motion = time_path(result.path, setup.robot.limits, result.joint_names, fault=fault).trajectory
    except TimingError as error:
        return found | {"reason": str(error)}
    states = sampled(motion, spacings[1])
    return found | {"motion": [len(states), colliding(setup, states)]}


def check_missing(
    kept: Path, files: dict[str, Path], spacings: tuple[float, float], jobs: int
) -> dict[str, dict[str, Any]]:
    """Check what was not checked before, keep it, and return all counts by digest.

    Args:
        kept: File of the counts that are there.
        files: File of each path by its digest.
        spacings: Of states on paths and on motions [rad].
        jobs: Processes at once.
    """
    done = {row["digest"]: row for row in map(json.loads, kept.read_text().splitlines())} if kept.exists() else {}
    left = [file for key, file in files.items() if key not in done]
    commit = record.session()["commit"]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool, kept.open("a") as out:
        tasks = [pool.submit(partial(recheck, spacings=spacings), file) for file in left]
        for task in tqdm(as_completed(tasks), total=len(left), unit="path"):
            row = task.result() | {"commit": commit}
            done[row["digest"]] = row
            out.write(json.dumps(row) + "\n")
            out.flush()
    return done


def table_of(rows: list[dict[str, Any]]) -> tuple[list[str], list[list[Any]]]:
    """Return the table of checked paths by planner: its head and its rows."""
    head = ["planner", "paths", "states on them", "paths that collide", "timed motions", "not timed",
            "states on motions", "motions that collide"]  # fmt: skip
    table = []
    for label in ("all", *dict.fromkeys(row["label"] for row in rows)):
        mine = [row for row in rows if label in ("all", row["label"])]
        paths, motions = ([row[kind] for row in mine if row[kind]] for kind in ("path", "motion"))
        table.append([
            label, len(paths), sum(n for n, _ in paths), sum(hits > 0 for _, hits in paths),
            len(motions), len(mine) - len(motions), sum(n for n, _ in motions), sum(hits > 0 for _, hits in motions),
        ])  # fmt: skip
    return head, table


def main() -> None:
    """Check what is left, and write the table."""
    parser = record.parser(__doc__, jobs=2)
    parser.add_argument("--runs", default="head_to_head", help="folder in benchmarks/runs (default: %(default)s)")
    parser.add_argument("--spacing", type=positive_number, default=SPACING, metavar="RAD", help="on paths")
    parser.add_argument(
        "--motion-spacing", type=positive_number, default=MOTION_SPACING, metavar="RAD", help="on motions"
    )
    args = parser.parse_args()
    spacings = (args.spacing, args.motion_spacing)
    results = Results.load(RUNS / args.runs)
    solved = [run for run in results.runs if run["solved"]]
    stored = sorted((run["problem"], file, run) for run in solved if (file := results.plan_file(run)).exists())
    if not stored:
        raise SystemExit(f"{results.folder}: expected stored paths of solved runs, as bench --keep writes them")
    keys = [digest_of(file, spacings) for _, file, _ in stored]
    files = {key: file for key, (_, file, _) in zip(keys, stored, strict=True)}
    done = check_missing(make_folder(RUNS / "recheck") / f"{args.runs}.jsonl", files, spacings, args.jobs)
    rows = [
        {**done[key], "label": run["label"], "seed": run["seed"]} for key, (*_, run) in zip(keys, stored, strict=True)
    ]
    colliding_rows = [row for row in rows if any(row[kind] and row[kind][1] for kind in ("path", "motion"))]
    head, table = table_of(rows)
    text = "\n".join(record.row(r) for r in [head, ["---"] + ["---:"] * (len(head) - 1), *table])
    text += f"\n\nPaths of solved runs that were not stored: {len(solved) - len(stored)}."
    text += "".join(f"\n\nCollides: {r['label']} on {r['problem']}, seed {r['seed']}." for r in colliding_rows)
    made_with = record.made_with(results)
    commits = {made_with.pop("run_commits"), *(row["commit"] for row in rows)}  # a result is as old as its counts
    record.write(
        "recheck", {"table": {"head": head, "rows": table}, "colliding": colliding_rows}, text,
        spacing=f"{args.spacing:g} rad", motion_spacing=f"{args.motion_spacing:g} rad",
        run_commits="; ".join(sorted(commits)), **made_with,
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
