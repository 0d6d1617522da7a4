"""A robot in an afternoon: from the URDF of a package to a trained planner, by the documented commands alone.

``apex-ompl robot new``, ``check``, ``prepare`` and ``train`` are run with the options that docs/robots.md has, in a
folder of their own, and timed by the wall clock; a stage that is done is not run again. A ``note`` on how it went, by
hand in ``stages.json``, is shown. Then test problems, on which nothing was tuned or trained, are planned by apex with
the trained model, by apex without one, and by rrtconnect+polish; problems, times and columns are those of
:mod:`benchmarks.robots.any_robot`, the time limit is shorter.

Usage: python -m benchmarks.robots.afternoon [ROBOT] [-n 100] [--hours 2] [--jobs 2] [--folder FOLDER]
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from apex_ompl.robot import load_robot
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import write_atomically
from apex_ompl.util.schema import read_json
from apex_ompl.util.validation import check_name
from benchmarks.lib import record
from benchmarks.robots.any_robot import FIRST
from benchmarks.robots.boxes import Boxes
from benchmarks.robots.figures import PLANNERS, Figures, Rows
from benchmarks.robots.fleet import CELLS, PACKAGE

DEPENDS = (
    "@planning", "apex_ompl/onboarding", "apex_ompl/training", "benchmarks/robots/boxes.py",
    "benchmarks/robots/figures.py",
)  # fmt: skip
FOLDER = Path(__file__).parents[1] / "runs" / "afternoon"
TIMEOUT = 2.0  # of a plan, by the wall clock [s]
ROWS: Rows = {
    "apex with the model": ("apex", {}), "apex without a model": PLANNERS["apex"],
    "rrtconnect+polish": PLANNERS["rrtconnect+polish"],
}  # fmt: skip


def commands(name: str, file: Path, hours: float, jobs: int) -> dict[str, list[str]]:
    """Return the documented commands by stage."""
    cell, robot = CELLS[name], str(file)
    several = cell.places if len(cell.places) > 1 else ()
    places = [word for place in several for word in ("--at", ",".join(f"{x:g}" for x in place))]
    parallel = ["--jobs", str(jobs)]
    return {
        "new": ["new", *[f"{PACKAGE}/{cell.urdf}"] * len(cell.places), *places, "-o", robot],
        "prepare": ["prepare", robot, *parallel],
        "check": ["check", robot],
        "train": ["train", robot, "--hours", f"{hours:g}", *parallel],
    }


def made(name: str, folder: Path, hours: float, jobs: int) -> tuple[Path, dict[str, Any]]:
    """Run the commands that are not done yet; return the robot file, and what is known of the stages."""
    folder.mkdir(parents=True, exist_ok=True)
    file, notes = folder / f"{name}.robot.yaml", folder / "stages.json"
    known: dict[str, Any] = read_json(notes, "stages") if notes.exists() else {"seconds": {}, "said": {}}
    for stage, words in commands(name, file, hours, jobs).items():
        if stage in known["seconds"]:
            continue
        started = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "apex_ompl.cli", "robot", *words], stdout=subprocess.PIPE, text=True, check=True
        )
        known["seconds"][stage] = round(time.monotonic() - started, 1)
        known["said"][stage] = done.stdout.splitlines()
        known["commit"] = record.session()["commit"]
        write_atomically(notes, (json.dumps(known, indent=1) + "\n").encode())
    return file, known


def tables(
    known: dict[str, Any], told: dict[str, Any], mine: Figures, names: Iterable[str]
) -> tuple[dict[str, Any], str]:
    """Return the figures and their tables."""
    lines = [record.row(["stage", "wall s"]), record.row(["---", "---:"])]
    lines += [record.row([stage, f"{seconds:.0f}"]) for stage, seconds in known["seconds"].items()]
    lines += [
        record.row(["all", f"{sum(known['seconds'].values()):.0f}"]),
        *(["", known["note"]] if known.get("note") else []),
        "",
    ]
    done, checked = told["done"], told["done"]["validation"]
    lines += [
        f"{done['data']['paths']} paths of {done['data']['solved']} problems were generated in "
        f"{told['spent']['data'] / 60:.0f} min, {done['training']['step']} steps trained in "
        f"{told['spent']['training'] / 60:.0f} min. Validation, {checked['problems']} problems: {checked['verdict']} "
        f"(ratio of CPU times {checked['ratio']:.2f}, 95 % {checked['interval'][0]:.2f} to "
        f"{checked['interval'][1]:.2f}; solved {checked['solved'][0]} with the model, {checked['solved'][1]} without).",
        "", record.row(["test problems", "N", "unsolved by all", "in 1 s", "CPU s p50", "p95", "length rad"]),
        record.row(["---", *["---:"] * 6]),
    ]  # fmt: skip
    count, unsolved, outcomes = mine.outcomes(names)
    for label, one in outcomes.items():
        cells = ["-" if value is None else f"{value:.3f}" for value in one.values()]
        lines.append(record.row([label, count, unsolved, *cells]))
    figures = {"stages": known["seconds"], "training": done, "rows": outcomes}
    return figures, "\n".join(lines)


def main() -> None:
    """Run the commands, plan and write."""
    parser = record.parser(__doc__, n=100, of="test problems")
    parser.add_argument("robot", nargs="?", default="dual_ur5", help="(default: %(default)s)")
    parser.add_argument("--hours", type=float, default=2.0, help="of training (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: %(default)s)")
    parser.add_argument("--folder", type=Path, default=FOLDER, help="of the robots (default: %(default)s)")
    args = parser.parse_args()
    name = check_name(args.robot, "robot", CELLS)
    file, known = made(name, args.folder.resolve() / name, args.hours, args.jobs)
    told = read_json(file.parent / f"{name}.training" / "session.json", "training")
    mine, names = Figures(file, ROWS, TIMEOUT), [str(k) for k in range(FIRST, FIRST + args.n)]
    boxes = Boxes(load_robot(file), str(file))
    mine.run(names, lambda name: boxes.problem(int(name)))
    figures, table = tables(known, told, mine, names)
    record.write(
        f"afternoon_{name}", figures, table, n=args.n, hours=args.hours, jobs=args.jobs, limit=f"{TIMEOUT:g} s",
        stages_commit=known["commit"], run_commits="; ".join(mine.data["commits"]),
    )  # fmt: skip


if __name__ == "__main__":
    run_script(main)
