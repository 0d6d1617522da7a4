"""How many spheres pay: covers of different gaps, by what proofs and checkers cost with them.

The covers are files of make_cover's with different gaps. For each: leaves of an arm link and of
the whole robot, how large and how far from the meshes they are, the share of free states that they prove, the cost of
proofs and of the two stages of the checker, of free 256-state paths, and of rrtconnect's search on two problems.

Usage: python -m benchmarks.collision.covers FILE.json...
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from apex_ompl import MotionPlanner, problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.cover.spheres import quality, read_covers, shape_key
from apex_ompl.paths.path import FINE_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.robot import load_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.collision.collision_checker import around_home, boxes, microseconds, of_batch
from benchmarks.lib import record

DEPENDS = ("@checking", "apex_ompl/ompl", "problems", "benchmarks/collision/collision_checker.py")
PROBLEMS = ("shelf_swap", "reach_past_post")


def measure(path: Path, states: int, seeds: int) -> dict[str, float]:
    """Return the figures of one file of covers."""
    rng = np.random.default_rng(0)
    robot = replace(load_robot("dual_panda_softhand"), covers=path)
    covers = read_covers(path)
    ratios, gaps, total = [], [], 0
    for item in robot.geometry.geometryObjects:
        cover = covers[shape_key(item.geometry)]
        total += len(cover.leaves)
        if "link" in item.name and item.name.startswith("left"):
            ratio, mean, _ = quality(item.geometry, cover, rng, 5000)
            ratios.append(ratio)
            gaps.append(mean * 1e3)
    found = {"leaves": total, "volume_ratio": float(np.mean(ratios)), "mean_gap_mm": float(np.mean(gaps))}
    proved, kernel_us, free_us, search_ms, full_ms = [], [], [], [], []
    for count in (3, 10, 30):
        checker = CollisionChecker(robot, boxes(count, rng))
        drawn = around_home(robot, rng, states)
        free = drawn[checker.are_free(drawn)]
        kernel = checker.kernel
        proved.append(float((kernel.unproved(free)[1] == 0).mean()))
        kernel_us.append(of_batch(kernel.unproved, free))
        free_us.append(microseconds(checker.is_free, free))
        for a, b in zip(free[:150], free[150:300], strict=False):
            for resolution, times in ((SEARCH_RESOLUTION, search_ms), (FINE_RESOLUTION, full_ms)):
                start = time.perf_counter()
                clear = checker.first_collision(np.stack([a, b]), resolution) is None
                if clear:
                    times.append((time.perf_counter() - start) * 1e3)
    found |= {"proved_of_free": float(np.mean(proved)), "proof_us": float(np.mean(kernel_us))}
    found |= {"two_stages_free_us": float(np.mean(free_us))}
    found |= {"free_motion_search_ms": float(np.median(search_ms)), "free_motion_full_ms": float(np.median(full_ms))}
    with MotionPlanner(robot) as planner:
        for name in PROBLEMS:
            problem = problems.load(name)
            runs = [planner.plan_problem(problem, "rrtconnect", timeout=10.0, seed=seed) for seed in range(seeds)]
            found[f"{name}_solve_ms"] = float(np.median([r.times["solve"] for r in runs])) * 1e3
    return found


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--states", type=one_or_more, default=3000)
    parser.add_argument("--seeds", type=one_or_more, default=10)
    args = parser.parse_args()
    figures = [{"covers": path.stem, **measure(path, args.states, args.seeds)} for path in args.files]
    head = list(figures[0])
    rows = [[f"{v:.3g}" if isinstance(v, float) else v for v in row.values()] for row in figures]
    lines = [record.row([h.replace("_", " ") for h in head]), record.row(["---"] + ["---:"] * (len(head) - 1))]
    record.write("covers", {"covers": figures}, "\n".join([*lines, *(record.row(r) for r in rows)]), seed=0,
                 N=args.states, seeds=args.seeds)  # fmt: skip


if __name__ == "__main__":
    run_script(main)
