"""How long the compiled kernel takes to be ready: compiled for the first time, and loaded from the cache.

Runs fresh processes, the first with an empty cache folder, and times import, robot, ``CollisionChecker.prepare``, the
first state and motion checked, and the first plan by the default planner.

Usage: python benchmarks/kernel_start.py [--runs 5]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile

import numpy as np
import record

from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more

DEPENDS = ("@checking", "apex_ompl/api.py")
CODE = """
import json, time
marks = [time.perf_counter()]
import apex_ompl.api
marks.append(time.perf_counter())
from apex_ompl.collision import CollisionChecker
robot = apex_ompl.load_robot("dual_panda_softhand")
marks.append(time.perf_counter())
checker = CollisionChecker(robot)
checker.prepare()
marks.append(time.perf_counter())
assert checker.is_free(robot.home)
marks.append(time.perf_counter())
other = robot.home.copy()
other[:3] += 0.1
assert checker.first_collision([robot.home, other], 0.031) is None
marks.append(time.perf_counter())
assert apex_ompl.plan("ball_in_cup")
marks.append(time.perf_counter())
print(json.dumps([b - a for a, b in zip(marks, marks[1:])]))
"""
STAGES = ("import", "robot", "prepare", "first state", "first motion", "first plan")


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=one_or_more, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        env = {**os.environ, "NUMBA_CACHE_DIR": folder}

        def once() -> list[float]:
            done = subprocess.run([sys.executable, "-c", CODE], env=env, capture_output=True, text=True, check=True)
            return list(json.loads(done.stdout))

        cold, warm = once(), [once() for _ in range(args.runs)]
    rows = [["compiled, once", *cold, sum(cold)], ["from the cache, median", *np.median(warm, axis=0)]]
    rows[1].append(float(np.median(np.sum(warm, axis=1))))
    figures = {"stages": STAGES, "cold_s": cold, "warm_s": warm}
    lines = [record.row(["seconds", *STAGES, "sum"]), record.row(["---"] + ["---:"] * (len(STAGES) + 1))]
    lines += [record.row([row[0], *(f"{v:.2f}" for v in row[1:])]) for row in rows]
    record.write("kernel_start", figures, "\n".join(lines), N=args.runs)


if __name__ == "__main__":
    run_script(main)
