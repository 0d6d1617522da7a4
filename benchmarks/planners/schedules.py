"""Two arms with steps of their own: makespans of asynchronous, synchronous and sequential schedules, and contacts.

Two kinds of cells are drawn by seed, for two Pandas with hands above their tables. In ``transfer``, the left arm takes
parts from its side and puts them down in the middle, from where the right arm takes each to its own side: the right arm
waits for each part, and the left one until the part before has been taken. In ``crossing``, both arms visit places on
their side and in the middle, and wait for nothing. An arm stays 0.1 to 1 s at each place. All rows have the same steps,
goal states, planner, seed and largest number of planned motions.

Each asynchronous schedule is checked anew at samples 1 ms apart by Coal on the meshes, without sphere covers. Cells are
kept in benchmarks/runs/schedules when they are done; the command resumes.

Usage: python -m benchmarks.planners.schedules [-n 100] [--split test] [--report]
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from tqdm import tqdm

from apex_ompl import MotionPlanner, PoseTarget, Trajectory
from apex_ompl.collision import CollisionChecker
from apex_ompl.planning.schedules import MODES, ArmStep, schedule
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record
from benchmarks.lib.pack import RUNS

DEPENDS = ("@planning", "apex_ompl/timing", "apex_ompl/moving")
FOLDER = RUNS / "schedules"
KINDS = ("transfer", "crossing")
SEEDS = {"test": 900_000, "validation": 800_000}
PARTS = 3  # that are handed over in a cell; visits of each arm in the other kind are twice as many
HOLD = 0.1, 1.0  # at each place [s]
OWN = np.array([0.3, 0.3, 0.25]), np.array([0.6, 0.7, 0.55])  # places on the left arm's side [m]
MIDDLE = np.array([0.4, -0.1, 0.3]), np.array([0.6, 0.1, 0.5])
SIDES = {"left": (OWN, MIDDLE), "right": (MIDDLE, OWN)}  # where each arm takes a part, and puts it
MOST_PLANS = 60  # of each schedule
TIMEOUT = 600.0  # so that the number of plans ends the search, and not a busy machine [s]
SAMPLE = 0.001  # of the check [s]
HEAD = (
    "kind", "cells", "all three solved", "asynchronous s p50", "synchronous s p50", "sequential s p50",
    "shorter than synchronous %, mean (p5 to p95)", "than sequential %", "plans p50", "CPU s p50 (p95)",
    "contacts at 1 ms", "states checked",
)  # fmt: skip


def places(rng: np.random.Generator, side: str, where: tuple[Array, Array]) -> Array:
    """Return a random place of a hand, mirrored to the arm's side, shape (3,) [m]."""
    x, y, z = rng.uniform(*where)
    return np.array([x, y if side == "left" else -y, z])


def reached(
    planner: MotionPlanner, rng: np.random.Generator, side: str, where: tuple[Array, Array]
) -> dict[str, float]:
    """Return joint values of an arm with its hand at a random place; places without such a state are drawn again."""
    names = [planner.robot.joint_names[k] for k in planner.robot.groups[f"{side}_arm"]]
    while True:
        place = PoseTarget(frame=f"{side}_hand", position=tuple(places(rng, side, where)))
        found = planner.ik(place, near="home", group=f"{side}_arm", count=1, descents=64)
        if found:
            values = dict(zip(planner.robot.joint_names, found[0].state.tolist(), strict=True))
            return {name: values[name] for name in names}


def cell(planner: MotionPlanner, kind: str, seed: int) -> list[ArmStep]:
    """Return the steps of a random cell."""
    rng, steps = np.random.default_rng([seed, KINDS.index(kind)]), list[ArmStep]()
    for k in range(PARTS):
        for side, ends in SIDES.items():
            first, second = (reached(planner, rng, side, where) for where in ends)
            if kind == "crossing" and rng.random() < 0.5:
                first, second = second, first
            take, put = tuple[str, ...](), tuple[str, ...]()
            if kind == "transfer" and side == "right":
                take = (f"left {k} put",)
            if kind == "transfer" and side == "left" and k:
                put = (f"right {k - 1} take",)
            for name, goal, after in (("take", first, take), ("put", second, put)):
                steps.append(ArmStep(f"{side} {k} {name}", f"{side}_arm", goal, after, float(rng.uniform(*HOLD))))
    for side in SIDES:
        steps.append(ArmStep(f"{side} away", f"{side}_arm", reached(planner, rng, side, OWN)))
    return steps


def contacts(motion: Trajectory, planner: MotionPlanner) -> tuple[int, int]:
    """Return how many samples of a motion collide by the meshes alone, and how many there are."""
    meshes = CollisionChecker(planner.robot, proofs=False)
    times = np.append(np.arange(0.0, motion.duration, SAMPLE), motion.duration)
    return int((~meshes.are_free(motion(times))).sum()), len(times)


def examined(planner: MotionPlanner, kind: str, seed: int) -> dict[str, Any]:
    """Return the figures of a cell."""
    steps, found = cell(planner, kind, seed), dict[str, Any]()
    for mode in MODES:
        started = time.process_time()
        made = schedule(planner, "home", steps, timeout=TIMEOUT, seed=seed, mode=mode, most_plans=MOST_PLANS)
        found[mode] = {
            "solved": bool(made), "makespan": made.makespan if made else None, "reason": made.reason,
            "orders": made.orders, "plans": made.plans, "seconds": time.process_time() - started,
        }  # fmt: skip
        if mode == MODES[0] and made.trajectory is not None:
            found["contacts"], found["states"] = contacts(made.trajectory, planner)
    return found


def shares(runs: Sequence[Mapping[str, Any]], other: str) -> str:
    """Return by how much asynchronous makespans are shorter than others, in percent."""
    gains = [100.0 * (1.0 - run[MODES[0]]["makespan"] / run[other]["makespan"]) for run in runs]
    low, high = record.percentiles(gains, 5, 95)
    return f"{np.mean(gains):.1f} ({low:.1f} to {high:.1f})" if gains else "-"


def row(kind: str, runs: Sequence[Mapping[str, Any]]) -> list[Any]:
    """Return the row of a kind."""
    solved = [run for run in runs if all(run[mode]["solved"] for mode in MODES)]
    ends = [f"{np.median([run[mode]['makespan'] for run in solved]):.2f}" if solved else "-" for mode in MODES]
    seconds = record.percentiles([run[MODES[0]]["seconds"] for run in runs], 50, 95)
    checked = [run for run in runs if "contacts" in run]
    low, high = share_interval(len(solved), len(runs))
    return [
        kind, len(runs), f"{len(solved)} ({100 * low:.0f} to {100 * high:.0f} %)", *ends, shares(solved, MODES[1]),
        shares(solved, MODES[2]), f"{np.median([run[MODES[0]]['plans'] for run in runs]):.0f}",
        f"{seconds[0]:.1f} ({seconds[1]:.1f})", sum(run["contacts"] for run in checked),
        sum(run["states"] for run in checked),
    ]  # fmt: skip


def main() -> None:
    """Examine what is missing, and write the results."""
    parser = record.parser(__doc__ or "", n=100, of="cells of a kind")
    parser.add_argument("--split", default="test", choices=SEEDS)
    parser.add_argument("--report", action="store_true", help="plan nothing; write the results of the stored cells")
    given = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    names = [(kind, SEEDS[given.split] + k) for k in range(given.n) for kind in KINDS]
    files = {name: FOLDER / f"{name[0]}-{name[1]}.json" for name in names}
    with MotionPlanner() as planner:
        for name in tqdm([] if given.report else [name for name in names if not files[name].exists()]):
            made = examined(planner, *name) | {"commit": record.session()["commit"]}
            write_atomically(files[name], json.dumps(made, indent=1).encode())
    runs = {name: json.loads(file.read_text()) for name, file in files.items() if file.exists()}
    each = {kind: [run for name, run in runs.items() if name[0] == kind] for kind in KINDS}
    rows = [row(kind, some) for kind, some in (*each.items(), ("all", list(runs.values()))) if some]
    table = "\n".join(record.row(list(line)) for line in (HEAD, ["---", *["---:"] * (len(HEAD) - 1)], *rows))
    reasons = {f"{n[0]} {n[1]}": [run[m]["reason"] for m in MODES if run[m]["reason"]] for n, run in runs.items()}
    data = {"columns": HEAD, "rows": rows, "failures": {name: some for name, some in reasons.items() if some}}
    commits = "; ".join(sorted({one["commit"] for one in runs.values()}))
    record.write("schedules", data, table, split=given.split, n=len(runs), run_commits=commits)


if __name__ == "__main__":
    run_script(main)
