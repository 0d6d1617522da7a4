"""Tables of clearances of links few joints apart: what they cost, and which share of free states is proved with them.

For each robot, which is alone: the tables that are made from scratch, their size and the CPU time for them; the share
of free random states that the kernel proves by covers alone and with the tables, and its time for a free state; and
whether the meshes find a collision at a state, or along a short motion, that is proved free.

Usage: python -m benchmarks.collision.near_pairs ROBOT...   (names, or robot files)
"""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from apex_ompl.collision import CollisionChecker, conservative
from apex_ompl.collision.clearance_making import TableReport, make_clearances
from apex_ompl.collision.clearance_tables import Cells, keep_clearances
from apex_ompl.kernel import Kernel
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.robot import Robot, load_robot
from apex_ompl.types import Array
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record

DEPENDS = ("@checking", "benchmarks/collision/near_pairs.py")
STEP = 0.1  # length of a motion, as a share of the way to another random state
TESTED = np.linspace(0.0, 1.0, 17)[:, None]  # states of a motion that the meshes check


def kernel_of(robot: Robot, cells: dict[str, Cells]) -> Kernel:
    """Return the kernel of a robot with some tables."""
    keep_clearances(robot, cells)
    conservative.forget_tables(robot)
    return CollisionChecker(robot).kernel


def wrongly_free(robot: Robot, kernel: Kernel, states: Array, free: Array) -> tuple[int, int, int]:
    """Return how many states and motions are wrongly proved free, and how many motions are proved."""
    wrong = int(((kernel.unproved(states)[1] == 0) & ~free).sum())
    meshes, starts = CollisionChecker(robot, proofs=False), states[free]
    motions = wrong_motions = 0
    for a, b in zip(starts, np.roll(states[: len(starts)], 1, axis=0), strict=True):
        motion = np.stack([a, a + STEP * (b - a)])
        if kernel.proves(motion, SEARCH_RESOLUTION):
            motions += 1
            wrong_motions += not meshes.are_free(motion[0] + TESTED * (motion[1] - motion[0])).all()
    return wrong, wrong_motions, motions


def worst_pairs(kernel: Kernel, states: Array, most: int = 3) -> str:
    """Return the pairs that most states leave open, with the shares of these states."""
    found, counts = kernel.unproved(states)
    names = kernel.robot.body_names
    pairs = Counter(
        (names[a], names[b]) for rows, n in zip(found, counts, strict=True) for a, b in rows[: max(n, 0)].tolist()
    )
    return ", ".join(f"{a} and {b} {count / len(states):.0%}" for (a, b), count in pairs.most_common(most))


def measure(robot: Robot, number: int, seconds: float) -> dict[str, float | int | str]:
    """Return the figures of one robot."""
    reports: list[TableReport] = []
    keep_clearances(robot, {})
    start = time.process_time()
    cells = make_clearances(robot, seconds, reports.append)
    took = time.process_time() - start
    states = robot.random_state(np.random.default_rng(1), number)
    free = CollisionChecker(robot, proofs=False).are_free(states)
    found: dict[str, float | int | str] = {
        "robot": robot.name, "dof": robot.dof, "pairs": len(robot.geometry.collisionPairs), "free": float(free.mean()),
        "tables": len(cells), "size_kB": sum(one.nbytes for one in cells.values()) / 1e3, "making_s": took,
    }  # fmt: skip
    for name, tables in (("covers", {}), ("tables", cells)):
        kernel = kernel_of(robot, tables)
        kernel.unproved(states[free])
        start = time.process_time()
        proved = kernel.unproved(states[free])[1] == 0
        found[f"us_{name}"] = (time.process_time() - start) / max(int(free.sum()), 1) * 1e6
        found[f"proved_{name}"] = float(proved.mean())
    found["wrong_states"], found["wrong_motions"], found["proved_motions"] = wrongly_free(robot, kernel, states, free)
    found["left"] = worst_pairs(kernel, states[free])
    for report in reports:
        print(report, flush=True)
    print(found, flush=True)
    return found


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__)
    parser.add_argument("robots", nargs="+", help="names of robots, or robot files")
    parser.add_argument("-n", "--states", type=one_or_more, default=10_000)
    parser.add_argument("--seconds", type=float, default=60.0, help="CPU time for the tables of a robot")
    args = parser.parse_args()
    figures = [measure(load_robot(name), args.states, args.seconds) for name in args.robots]
    head = (
        "robot", "joints", "pairs", "tables", "kB", "CPU s", "proved by covers", "with tables", "us a state",
        "with tables", "wrongly free states", "wrongly free motions", "of proved", "left open",
    )  # fmt: skip
    rows = [
        (
            f["robot"], f["dof"], f["pairs"], f["tables"], f"{f['size_kB']:.0f}", f"{f['making_s']:.1f}",
            f"{f['proved_covers']:.1%}", f"**{f['proved_tables']:.1%}**", f"{f['us_covers']:.1f}",
            f"{f['us_tables']:.1f}", f["wrong_states"], f["wrong_motions"], f["proved_motions"], f["left"],
        )
        for f in figures
    ]  # fmt: skip
    lines = [record.row(head), record.row(["---", *["---:"] * (len(head) - 2), "---"])]
    record.write("near_pairs", {"robots": figures}, "\n".join([*lines, *map(record.row, rows)]), seed=1,
                 N=args.states, seconds=args.seconds)  # fmt: skip


if __name__ == "__main__":
    run_script(main)
