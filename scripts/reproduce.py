"""Reproduce the paper: its figures, each with numbers, a table and a picture, and the page that compares them.

``failure``: failure ratio R_f and smoothness S_r by task, all planners.
``size``: failure ratio over the size of static cubes, guided and unguided.
``time``: planning time; one run at a time, on a machine that does nothing else.
``dynamic``: failure ratio by task and over size among cubes that pass, and the effect of the choices of the loop.
``imposed``: failure ratio over the size of cubes that are brought into the way, and stand.
``fid``: FID and KID of all algorithms.
``denoising``, ``diversity``: pictures of the denoising steps, and of several proposals.
``strips``: pictures of runs with and without guidance.
``failures``: a collision, a robot that is stuck, a wrong alignment.
``page``: docs/paper.md, from the results. ``all``: all of these.

Runs of a cell, by default: 100 of one sample on each task and size, 300 in the cells of the central claim (the largest
cubes, guided and not, standing, passing and brought in), 200 of apex on a size, 60 on each size of moving cubes, and 20
of the other planners on each task and size; ``-n`` is the largest number on a level (:mod:`paper.rows`).

Every run is stored in benchmarks/runs when it ends: stop the command at any moment and give it again. ``failure`` and
``size`` have the same runs; ``strips`` and ``failures`` pick theirs from those of ``dynamic``. ``--parts 1`` makes the
runs of the central claim alone, ``--report`` none; both write what the stored runs tell. ``python -m
benchmarks.lib.pack pack paper_static`` packs those of a folder into benchmarks/packed at any moment, and ``unpack``
brings them to another machine, where the command resumes.

Usage: python scripts/reproduce.py all|FIGURE|page [-n N] [--jobs 2] [--parts M] [--report] [--keep FOLDER]
    [-o FOLDER] [--page FILE]
"""

from __future__ import annotations

import argparse
import importlib
import sys
import traceback
from datetime import datetime
from pathlib import Path

from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder
from apex_ompl.util.validation import one_or_more

ROOT = Path(__file__).resolve().parents[1]
DEPENDS = (
    "@benchmark", "apex_ompl/training", "apex_ompl/training", "apex_ompl/baselines/imitation", "apex_ompl/moving",
    "apex_ompl/loop", "apex_ompl/baselines", "benchmarks/baselines", "apex_ompl/timing", "apex_ompl/viz",
    "scripts/paper/examples.py", "scripts/paper/fid.py", "scripts/paper/figure.py",
    "scripts/paper/model_pictures.py", "scripts/paper/motions.py", "scripts/paper/moving.py",
    "scripts/paper/realism.py", "scripts/paper/rows.py", "scripts/paper/static.py",
)  # fmt: skip
MOST = 1000  # more than any row has on a level
FIGURES = {
    "time": ("static", 20, "problems of a task"),
    "failure": ("static", MOST, "problems of a level"),
    "size": ("static", MOST, "problems of a level"),
    "imposed": ("moving", MOST, "worlds of a level"),
    "dynamic": ("moving", MOST, "worlds of a level"),
    "strips": ("examples", 5, "worlds of a level"),
    "failures": ("examples", 5, "worlds of a level"),
    "fid": ("fid", 400, "problems in all"),
    "denoising": ("model_pictures", 1, "problems"),
    "diversity": ("model_pictures", 12, "trajectories"),
}
"""Module of each figure, in the order of ``all``, with the default number of problems or runs and its unit."""
ALL, PAGE = "all", "page"
STORED = ("time", "failure", "size", "imposed", "dynamic")


def parsed() -> argparse.Namespace:
    """Return the arguments."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figure", choices=(ALL, *FIGURES, PAGE))
    usual = "; ".join(f"{name}: {n} {what}" for name, (_, n, what) in FIGURES.items())
    parser.add_argument("-n", type=one_or_more, help=f"number of problems or runs of a figure (defaults: {usual})")
    parser.add_argument("--jobs", type=one_or_more, default=2, help="runs at a time, except for time (default: 2)")
    parser.add_argument("--report", action="store_true", help="run nothing; write the results of the stored runs")
    parser.add_argument("--parts", type=one_or_more, metavar="M", help="make the first M parts of the runs alone")
    parser.add_argument("--keep", type=Path, default=ROOT / "benchmarks" / "runs", metavar="FOLDER", help="for runs")
    parser.add_argument("-o", "--out", type=Path, default=ROOT / "benchmarks" / "results", metavar="FOLDER")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "paper.md", metavar="FILE")
    args = parser.parse_args()
    if args.n is not None and args.figure in (ALL, PAGE):
        parser.error("-n is for one figure")
    if args.report and args.figure not in STORED:
        parser.error(f"--report is for {', '.join(STORED)}")
    if args.parts is not None and args.figure not in STORED:
        parser.error(f"--parts is for {', '.join(STORED)}")
    if args.n is not None and args.figure == "fid" and args.n < 4:
        parser.error("-n of fid is 4 or more")
    return args


def main() -> None:
    """Make a figure, the page, or all; of all, a figure that fails does not keep the others from being made."""
    args = parsed()
    sys.path.append(str(ROOT))  # for benchmarks.lib.record
    make_folder(args.keep)
    make_folder(args.out)
    importlib.import_module("matplotlib.figure")  # a missing one is reported now, not after hours
    if args.figure == ALL:
        everything(args)
    else:
        make(args.figure, args)


def make(figure: str, args: argparse.Namespace) -> None:
    """Make one figure, or the page.

    Raises:
        ApexError: Runs that are kept are of something else, or a file cannot be written.
    """
    if figure == PAGE:
        importlib.import_module("paper.page").write(args.out, args.page)
        return
    module, usual, _ = FIGURES[figure]
    wanted = argparse.Namespace(**{**vars(args), "n": args.n or usual})
    getattr(importlib.import_module(f"paper.{module}"), figure)(wanted).write(figure, wanted)


def everything(args: argparse.Namespace) -> None:
    """Make all figures and the page.

    Raises:
        SystemExit: One failed.
    """
    failed = []
    for figure in (*FIGURES, PAGE):
        print(f"{datetime.now():%H:%M} {figure}", flush=True)
        try:
            make(figure, args)
        except Exception:
            traceback.print_exc()
            failed.append(figure)
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}; give the command again for those")


if __name__ == "__main__":
    run_script(main, "bench,data,viz")
