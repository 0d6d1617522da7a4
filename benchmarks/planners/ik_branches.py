"""Inverse kinematics against a dense search: share of its branches that ``planner.ik`` finds, and time a solution.

Targets are poses of the Panda's hand at random free states. The dense search descends from random states by SciPy's
bounded least squares on Pinocchio's logarithm of the pose; a free state of it counts as found where a solution is
within the spacing of solutions, 0.1 rad in each joint. Times are those of the process. Targets are kept in
benchmarks/runs/ik_branches when they are done, in order; the command resumes.

Usage: python -m benchmarks.planners.ik_branches [-n 10000] [--split test] [--report]
"""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares
from tqdm import tqdm

from apex_ompl import MotionPlanner, PoseTarget
from apex_ompl.goals.self_motions import SPACING
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.statistics import share_interval
from benchmarks.lib import record
from benchmarks.lib.pack import RUNS

DEPENDS = ("@planning",)
FOLDER = RUNS / "ik_branches"
SEEDS = {"test": 900_000, "validation": 800_000}
ROBOT, HAND = "panda", "hand"
STARTS = 30  # of the dense search
STEPS = 100  # most evaluations of each descent
COUNT = 1000  # most solutions
REACHED = 1e-7  # largest element of the logarithm
HEAD = (
    "targets", "states of the dense search", "found %", "95 % interval", "targets without a solution but one of its",
    "solutions p50", "CPU ms a solution p50", "p95", "CPU ms a target p50", "p95",
)  # fmt: skip


def dense(planner: MotionPlanner, wanted: pin.SE3, rng: np.random.Generator) -> list[Array]:
    """Return free states that reach a pose of the hand, by SciPy and Pinocchio from random states."""
    robot, found = planner.robot, list[Array]()
    limits, hand, data = robot.limits, robot.hands[HAND], robot.model.createData()
    frame, point = robot.model.getFrameId(hand.palm), pin.SE3(np.eye(3), np.array(hand.point))

    def off(q: Array) -> pin.SE3:
        pin.framesForwardKinematics(robot.model, data, robot.to_pinocchio(q))
        return wanted.actInv(data.oMf[frame] * point)

    def residual(q: Array) -> Array:
        return np.asarray(pin.log6(off(q)).vector)

    def jacobian(q: Array) -> Array:
        here = pin.Jlog6(off(q)) @ point.toActionMatrixInverse()
        columns = pin.computeFrameJacobian(robot.model, data, robot.to_pinocchio(q), frame, pin.LOCAL)
        return np.asarray(here @ columns[:, np.argsort(robot.state_order)])

    for q in robot.random_state(rng, STARTS):
        end = least_squares(residual, q, jacobian, bounds=(limits.lower, limits.upper), xtol=1e-12, max_nfev=STEPS)
        if np.abs(end.fun).max() < REACHED and planner.is_free(end.x):
            found.append(end.x)
    return found


def examined(planner: MotionPlanner, seed: int) -> dict[str, Any]:
    """Return the figures of a target."""
    rng, q = np.random.default_rng(seed), planner.robot.home
    while not planner.is_free(q := planner.robot.random_state(rng)):
        pass
    pose = pin.SE3(planner.fk(q, HAND))
    xyzw = tuple(pin.Quaternion(pose.rotation).coeffs().tolist())
    target = PoseTarget(frame=HAND, position=tuple(pose.translation.tolist()), orientation=xyzw)
    started = time.process_time()
    found = planner.ik(target, count=COUNT, seed=seed)
    seconds = time.process_time() - started
    others = dense(planner, pose, rng)
    near = [bool(len(found)) and bool((np.abs(found.states - q).max(axis=1) < SPACING).any()) for q in others]
    return {"seed": seed, "solutions": len(found), "seconds": seconds, "dense": len(near), "found": sum(near)}


def main() -> None:
    """Examine what is missing, and write the results."""
    parser = record.parser(__doc__ or "", n=10_000, of="targets")
    parser.add_argument("--split", default="test", choices=SEEDS)
    parser.add_argument("--report", action="store_true", help="solve nothing; write the results of the stored targets")
    given = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    file = FOLDER / f"{given.split}.jsonl"
    runs = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    with MotionPlanner(ROBOT) as planner, file.open("a") as out:
        planner.ik(PoseTarget(frame=HAND, position=(0.5, 0.0, 0.4)), count=1)  # loads the code
        for k in tqdm(range(len(runs), 0 if given.report else given.n)):
            made = examined(planner, SEEDS[given.split] + k) | {"commit": record.session()["commit"]}
            runs.append(made)
            out.write(json.dumps(made) + "\n")
            out.flush()
    total, found = sum(run["dense"] for run in runs), sum(run["found"] for run in runs)
    low, high = share_interval(found, total)
    each = [1e3 * run["seconds"] / run["solutions"] for run in runs if run["solutions"]]
    whole = [1e3 * run["seconds"] for run in runs]
    row = [
        len(runs), total, f"{100 * found / total:.2f}", f"{100 * low:.2f} to {100 * high:.2f}",
        sum(not run["solutions"] and run["dense"] > 0 for run in runs),
        f"{np.median([run['solutions'] for run in runs]):.0f}",
        *(f"{value:.2f}" for value in record.percentiles(each, 50, 95)),
        *(f"{value:.0f}" for value in record.percentiles(whole, 50, 95)),
    ]  # fmt: skip
    table = "\n".join(record.row(list(line)) for line in (HEAD, ["---:"] * len(HEAD), row))
    commits = "; ".join(sorted({run["commit"] for run in runs}))
    record.write(
        "ik_branches", {"columns": HEAD, "row": row}, table, split=given.split, n=len(runs), run_commits=commits
    )


if __name__ == "__main__":
    run_script(main)
