"""Twelve robots from their URDFs: what is proved of their states, what preparing costs, and how fast they are planned for.

Each robot is set up by ``apex-ompl robot new`` and prepared by ``apex-ompl robot prepare`` with default settings; a
preparation that the time budget stopped goes on at the next call of this command. Shares are those of
``apex-ompl robot check``, on states that nothing was tuned on. Problems are random free starts and goals among boxes
(:mod:`benchmarks.robots.boxes`). Apex has no model here: random perturbations take the place of proposals. Both planners
have the same checker, problems, seeds and limit by the wall clock. Times are CPU times of whole calls of
``MotionPlanner.plan_problem`` without timing; ``in 1 s`` counts problems that were solved in 1 s of it, and percentiles
are over all problems, those without a path last. Figures are kept in benchmarks/runs/robots, one file a robot; the
command makes what is missing.

Usage: python -m benchmarks.robots.any_robot [ROBOT...] [-n 100] [--budget 300] [--folder FOLDER]
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

import numpy as np

from apex_ompl import MotionPlanner
from apex_ompl.collision.cover.preparation import Preparation, prepare
from apex_ompl.collision.cover.survey import survey
from apex_ompl.robot import load_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import read_json
from apex_ompl.util.validation import check_name
from benchmarks.lib import record
from benchmarks.robots.boxes import Boxes
from benchmarks.robots.fleet import CELLS, robot_file

DEPENDS = ("@planning", "benchmarks/robots/fleet.py", "benchmarks/robots/boxes.py")
FOLDER = Path(__file__).parents[1] / "runs" / "robots"
PLANNERS = {"apex": {"model": "none"}, "rrtconnect+polish": {}}
TIMEOUT = 30.0  # of a call, by the wall clock of a machine that does other things too [s]
SOON = 1.0  # [s]
SAMPLES, SEED = 2000, 7  # states of the shares
FIRST = 5000  # number of the first problem; those below are for tuning


def cpu() -> float:
    """Return the CPU time of this process and of those that it has waited for [s]."""
    return sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))


class Kept:
    """Figures of one robot, in a file that is written after each."""

    def __init__(self, file: Path) -> None:
        """Read what there is."""
        self.file = file
        self.data: dict[str, Any] = read_json(file, "figures of a robot") if file.exists() else {"runs": {}}

    def write(self, **figures: Any) -> None:
        """Add figures."""
        self.data |= figures
        write_atomically(self.file, (json.dumps(self.data, indent=1) + "\n").encode())


def prepared(name: str, folder: Path, budget: float, jobs: int) -> tuple[Path, Kept]:
    """Return the file of a robot that is set up and prepared, and its figures."""
    file = robot_file(name, folder)
    kept = Kept(file.parent / "figures.json")
    if not kept.data.get("thorough"):
        began, started = cpu(), time.perf_counter()
        done = prepare(file, Preparation(budget=budget, jobs=jobs))
        used = kept.data.get("prepare_cpu_s", 0.0) + cpu() - began
        lasted = kept.data.get("prepare_wall_s", 0.0) + time.perf_counter() - started
        kept.data.pop("proved", None)
        kept.write(prepare_cpu_s=used, prepare_wall_s=lasted, thorough=done.thorough or lasted >= budget)
    if "proved" not in kept.data:
        robot = load_robot(file)
        found = survey(robot, SAMPLES, SEED)
        spoilers = {" and ".join(links): share for links, share in list(found.spoilers.items())[:3]}
        pairs = len(robot.geometry.collisionPairs)
        kept.write(dof=robot.dof, pairs=pairs, free=found.free, proved=found.proved, spoilers=spoilers)
    return file, kept


def run(name: str, file: Path, kept: Kept, count: int, first: int) -> None:
    """Plan for the problems that are missing."""
    missing = [k for k in range(first, first + count) if f"{k}" not in kept.data["runs"]]
    if not missing:
        return
    robot = load_robot(file)
    boxes, planner = Boxes(robot, str(file)), MotionPlanner(str(file))
    warm = boxes.problem(0)
    for one, params in PLANNERS.items():
        planner.plan_problem(warm, one, params=params, timeout=TIMEOUT, timing=False, seed=0)
    for number in missing:
        problem, row = boxes.problem(number), {}
        for one, params in PLANNERS.items():
            planner.world.clear()
            began = cpu()
            found = planner.plan_problem(problem, one, params=params, timeout=TIMEOUT, timing=False, seed=number)
            used = cpu() - began
            row[one] = {
                "solved": bool(found), "cpu_s": used, "length": found.length if found else None,
                "solved_by": found.solved_by,
            }  # fmt: skip
        kept.data["runs"][f"{number}"] = row
        kept.write()
        print(name, number, *(f"{one} {r['cpu_s']:.2f} s {r['solved_by']}" for one, r in row.items()), flush=True)


def percentile(runs: list[dict[str, Any]], p: float) -> float | None:
    """Return a percentile of the times of runs, those without a path last [s]; None where it is none of them."""
    return record.reached([run["cpu_s"] if run["solved"] else np.inf for run in runs], p)


def row_of(name: str, kept: Kept, numbers: list[str]) -> tuple[dict[str, Any], list[Any]]:
    """Return the figures of a robot, and its row of the table."""
    data = kept.data
    figures = {key: data[key] for key in ("dof", "pairs", "free", "proved", "spoilers", "prepare_cpu_s")}
    runs = [data["runs"][number] for number in numbers if number in data["runs"]]
    both = [run for run in runs if all(one["solved"] for one in run.values())]
    cells = [name, data["dof"], data["pairs"], f"{data['free']:.0%}", f"**{data['proved']:.0%}**",
             f"{data['prepare_cpu_s']:.0f}", len(runs)]  # fmt: skip
    figures |= {"robot": name, "n": len(runs)}
    for one in PLANNERS if runs else ():
        mine = [run[one] for run in runs]
        soon = float(np.mean([run["solved"] and run["cpu_s"] <= SOON for run in mine]))
        times = [percentile(mine, p) for p in (50, 95)]
        length = float(np.median([run[one]["length"] for run in both])) if both else None
        figures[one] = {"soon": soon, "p50_s": times[0], "p95_s": times[1], "length_rad": length}
        shown = ["-" if value is None else f"{value:.2f}" for value in (*times, length)]
        cells += [f"{soon:.2f}", *shown]
    spoilers = ", ".join(f"{pair} {share:.0%}" for pair, share in data["spoilers"].items())
    return figures, [*cells, spoilers]


def main() -> None:
    """Set up, prepare, plan and write."""
    parser = record.parser(__doc__, n=100, of="problems of a robot")
    parser.add_argument("robots", nargs="*", help=f"by default all of {', '.join(CELLS)}")
    parser.add_argument("--budget", type=float, default=300.0, help="of a preparation [s] (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes of a preparation (default: %(default)s)")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of robots and figures (default: %(default)s)")
    parser.add_argument("--first", type=int, default=FIRST, help="first problem (default: %(default)s)")
    args = parser.parse_args()
    names = [check_name(name, "robot", CELLS) for name in args.robots or CELLS]
    folder = args.folder.resolve()
    figures, rows = [], []
    numbers = [str(k) for k in range(args.first, args.first + args.n)]
    for name in names:
        file, kept = prepared(name, folder, args.budget, args.jobs)
        run(name, file, kept, args.n, args.first)
        one, cells = row_of(name, kept, numbers)
        figures.append(one)
        rows.append(cells)
    both = [f"{planner}: {what}" for planner in PLANNERS for what in ("in 1 s", "CPU s p50", "p95", "length rad")]
    head = ["robot", "joints", "pairs", "free", "proved", "prepare CPU s", "N", *both, "unproved pairs"]
    lines = [record.row(head), record.row(["---", *["---:"] * (len(head) - 2), "---"])]
    record.write("robots", {"robots": figures}, "\n".join([*lines, *map(record.row, rows)]), seed=SEED,
                 states=SAMPLES, limit=f"{TIMEOUT:g} s", budget=args.budget)  # fmt: skip


if __name__ == "__main__":
    run_script(main)
