"""Answers of this checkout's checker beside another one's: the same states and motions, answer by answer.

States are drawn over the limits, and around starts and goals of validation problems. Compared are whether each is free
(the kernel, and Coal's meshes for what it leaves), and the share that the kernel alone proves free; of short motions,
the share that it proves.

Usage: python -m benchmarks.collision.verdicts FOLDER [--states 1000000]
FOLDER is another checkout, ``git worktree add FOLDER COMMIT`` makes one.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import one_or_more
from benchmarks.lib import record
from benchmarks.lib.checkouts import add_checkout, commit, environment

DEPENDS = ("@checking", "benchmarks/lib/checkouts.py")
SUITES, LEVELS, SEEDS = ("shelf", "bins", "cage", "posts", "wall", "clutter", "swap"), ("medium", "hard"), (0, 1, 2)
MOTIONS = 1000  # of a problem
NAMES = [f"{suite}/{level}/80000{k}" for suite in SUITES for level in LEVELS for k in SEEDS]
STATES = """
import sys
import numpy as np
from apex_ompl import problems
from apex_ompl.collision import CollisionChecker
from apex_ompl.problems.suite_robot import robot

def drawn_states(problem, rng, count):
    limits, dof = robot().limits, robot().dof
    ends = problem.start_state(robot().joint_names), problem.goal_states(robot().joint_names)[0]
    drawn = [rng.uniform(limits.lower, limits.upper, (count - 2 * (count // 4), dof))]
    drawn += [end + 0.3 * rng.normal(size=(count // 4, dof)) for end in ends]
    return np.clip(np.concatenate(drawn), limits.lower, limits.upper)

"""
REPORT = """
out, each, motions, names = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:]
free, proved, moves = [], 0, 0
for seed, name in enumerate(names):
    problem, rng = problems.load(name), np.random.default_rng(seed)
    checker = CollisionChecker(robot(), problem.scene, problem.attached)
    states = drawn_states(problem, rng, each)
    rng.shuffle(states)
    free.append(checker.are_free(states))
    proved += int((checker.kernel.unproved(states)[1] == 0).sum())
    for a, b in zip(states[:motions], states[1:motions + 1]):
        moves += checker.kernel.proves(np.stack([a, a + 0.1 * (b - a)]), 0.031)
np.savez(out, free=np.concatenate(free), proved=proved, moves=moves)
"""


def main() -> None:
    """Compare, and write the results."""
    parser = record.parser(__doc__)
    add_checkout(parser)
    parser.add_argument("--states", type=one_or_more, default=1_000_000, help="(default: %(default)s)")
    args = parser.parse_args()
    each = -(-args.states // len(NAMES))
    with tempfile.TemporaryDirectory() as made:
        running = []
        for label, folder in (("before", args.folder), ("after", record.ROOT)):
            command = [
                sys.executable,
                "-c",
                STATES + REPORT,
                str(Path(made) / f"{label}.npz"),
                str(each),
                str(MOTIONS),
                *NAMES,
            ]
            running.append(subprocess.Popen(command, cwd=folder, env=environment(folder), stderr=subprocess.DEVNULL))
        if any([process.wait() for process in running]):
            raise SystemExit("a process has failed: is the folder a checkout of this project?")
        before, after = (dict(np.load(Path(made) / f"{label}.npz")) for label in ("before", "after"))
    states, moves = len(after["free"]), MOTIONS * len(NAMES)
    other = int((before["free"] != after["free"]).sum())
    head = ["", "N", "before", "after", "answered differently"]
    rows = [head, ["---", *["---:"] * 4]]
    rows.append(["free states", states, int(before["free"].sum()), int(after["free"].sum()), other])
    rows.append(["of these proved by the kernel", states, int(before["proved"]), int(after["proved"]), ""])
    rows.append(["short motions proved by the kernel", moves, int(before["moves"]), int(after["moves"]), ""])
    figures = {"states": states, "different": other, "motions": moves}
    figures |= {
        f"{k} {label}": int(v[k]) for label, v in (("before", before), ("after", after)) for k in ("proved", "moves")
    }
    record.write(
        "verdicts", figures, "\n".join(record.row(row) for row in rows), split="validation", problems=len(NAMES),
        before=commit(args.folder),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
