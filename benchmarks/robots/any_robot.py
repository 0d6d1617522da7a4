"""Robots from their URDFs: what is proved of their states, what that costs, and how fast they are planned for.

Each robot is set up by ``apex-ompl robot new`` and prepared by ``apex-ompl robot prepare`` with default settings; a
preparation that the time budget stopped goes on at the next call of this command. Shares are those of
``apex-ompl robot check``, on states that nothing was tuned on. Problems are random free starts and goals among boxes
(:mod:`benchmarks.robots.boxes`). Apex has no model here: random perturbations take the place of proposals. Both
planners have the same checker, problems, seeds and limit by the wall clock. Times are CPU times of whole calls of
``MotionPlanner.plan_problem`` without timing. Problems that neither planner solves, some of which have no solution, are
counted and left out. ``in 1 s`` is the share of the others that was solved in 1 s of CPU time, and percentiles are over
all of them, those without a path last. Lengths are medians over the problems that both solved. Figures are kept in
benchmarks/runs/robots, a file a robot; the command makes what is missing.

Usage: python -m benchmarks.robots.any_robot [ROBOT...] [-n 100] [--budget 300] [--folder FOLDER] [--name robots]
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from apex_ompl.robot import load_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.validation import check_name
from benchmarks.lib import record
from benchmarks.robots import figures
from benchmarks.robots.boxes import Boxes
from benchmarks.robots.fleet import CELLS, robot_file

DEPENDS = (
    "@planning", "benchmarks/robots/fleet.py", "benchmarks/robots/boxes.py", "benchmarks/robots/figures.py",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs" / "robots"
FIRST = 5000  # number of the first problem; those below are for tuning


def main() -> None:
    """Set up, prepare, plan and write."""
    parser = record.parser(__doc__, n=100, of="problems of a robot")
    parser.add_argument("robots", nargs="*", help=f"by default all of {', '.join(CELLS)}")
    parser.add_argument("--first", type=int, default=FIRST, help="first problem (default: %(default)s)")
    parser.add_argument("--name", default="robots", help="of the results (default: %(default)s)")
    figures.add_options(parser, FOLDER)
    args = parser.parse_args()
    names = [str(k) for k in range(args.first, args.first + args.n)]
    rows = {}
    for robot in [check_name(name, "robot", CELLS) for name in args.robots or CELLS]:
        file = robot_file(robot, args.folder.resolve())
        print(robot, flush=True)
        mine = figures.Figures(file)
        mine.prepare(args.budget, args.jobs)
        boxes = cache(lambda file=file: Boxes(load_robot(file), str(file)))
        mine.run(names, lambda name, boxes=boxes: boxes().problem(int(name)))
        rows[robot] = mine, names
    record.write(
        args.name,
        *figures.table(rows),
        n=args.n,
        budget=args.budget,
        run_commits=figures.run_commits(rows),
        **figures.SETTINGS,
    )


if __name__ == "__main__":
    run_script(main)
