"""Tables of clearances of links few joints apart: what they cost, and which share of free states is proved with them.

The robots are those of the PyPI package example-robot-data, as ``apex-ompl robot new`` sets them up, alone and with the
covers that are made at run time. For each: the tables that are made from scratch, their size and the CPU time for them;
the share of free random states that the kernel proves by covers alone and with the tables, and its CPU time for a free
state; and whether the meshes find a collision at a state, or along a short motion, that is proved free.

Usage: python -m benchmarks.collision.near_pairs [ROBOT...]
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from apex_ompl.collision import CollisionChecker
from apex_ompl.collision.clearance_making import TableReport, prepare_clearances
from apex_ompl.collision.clearance_tables import read_clearances
from apex_ompl.kernel import Kernel
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.robot import Robot, load_robot
from apex_ompl.robot.new import new_robot, sources_of
from apex_ompl.types import Array, Flags
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import check_name
from benchmarks.lib import record

DEPENDS = ("@checking", "benchmarks/collision/near_pairs.py")
PACKAGE = "package://example-robot-data/robots"
ROBOTS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "ur_description/srdf/ur5.srdf"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "xarm_description/srdf/xarm7.srdf"),
    "z1": ("z1_description/urdf/z1.urdf", "z1_description/srdf/z1.srdf"),
    "kinova": ("kinova_description/robots/kinova.urdf", "kinova_description/srdf/kinova.srdf"),
    "so101": ("so_arm_description/urdf/so101.urdf", ""),
}
"""Their URDFs and SRDFs."""
SEED = 1
STEP = 0.1  # length of a motion, as a share of the way to another random state
TESTED = np.linspace(0.0, 1.0, 17)[:, None]  # states of a motion that the meshes check


def set_up(name: str, folder: Path) -> Path:
    """Write the robot file of one of the robots, and return it."""
    urdf, srdf = ROBOTS[name]
    sources = sources_of([f"{PACKAGE}/{urdf}"], [f"{PACKAGE}/{srdf}"] if srdf else [])
    return new_robot(sources, folder / f"{name}.robot.yaml").file


def wrongly_free(robot: Robot, kernel: Kernel, states: Array, free: Flags) -> tuple[int, int, int]:
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
    return ", ".join(f"{a} and {b} {count / len(states):.1%}" for (a, b), count in pairs.most_common(most))


def proofs(kernel: Kernel, free: Array) -> tuple[float, float]:
    """Return the share of free states that a kernel proves, and its CPU time for one [us]."""
    kernel.unproved(free)
    start = time.process_time()
    counts = kernel.unproved(free)[1]
    return float((counts == 0).mean()), (time.process_time() - start) / len(free) * 1e6


def measure(file: Path, number: int, seconds: float) -> dict[str, Any]:
    """Return the figures of one robot, and write its tables."""
    reports: list[TableReport] = []
    bare = load_robot(file)
    kernels = {"covers": CollisionChecker(bare).kernel}
    states = bare.random_state(np.random.default_rng(SEED), number)
    free = CollisionChecker(bare, proofs=False).are_free(states)
    start = time.process_time()
    path = prepare_clearances(bare, seconds, reports.append)
    took = time.process_time() - start
    cells = {} if path is None else read_clearances(path)
    found: dict[str, Any] = {
        "robot": bare.name, "dof": bare.dof, "pairs": len(bare.geometry.collisionPairs), "free": float(free.mean()),
        "tables": len(cells), "size_kB": sum(one.nbytes for one in cells.values()) / 1e3, "making_s": took,
    }  # fmt: skip
    robot = load_robot(file)
    kernels["tables"] = CollisionChecker(robot).kernel
    for name, kernel in kernels.items():
        found[f"proved_{name}"], found[f"us_{name}"] = proofs(kernel, states[free])
    kernel = kernels["tables"]
    found["wrong_states"], found["wrong_motions"], found["proved_motions"] = wrongly_free(robot, kernel, states, free)
    found["left"] = worst_pairs(kernel, states[free])
    for report in reports:
        print(report, flush=True)
    print(found, flush=True)
    return found


def main() -> None:
    """Measure and write."""
    parser = record.parser(__doc__, n=2000, of="random states of a robot")
    parser.add_argument("robots", nargs="*", help=f"by default all of {', '.join(ROBOTS)}")
    parser.add_argument("--seconds", type=float, default=15.0, help="CPU time for one's tables (default: %(default)s)")
    args = parser.parse_args()
    names = [check_name(name, "robot", ROBOTS) for name in args.robots or ROBOTS]
    with TemporaryDirectory() as folder:
        figures = [measure(set_up(name, Path(folder)), args.n, args.seconds) for name in names]
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
    record.write("near_pairs", {"robots": figures}, "\n".join([*lines, *map(record.row, rows)]), seed=SEED,
                 N=args.n, seconds=args.seconds)  # fmt: skip


if __name__ == "__main__":
    run_script(main)
