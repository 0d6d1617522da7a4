"""Make a data set of verified paths: problems of the training split are drawn and solved, and valid paths are kept.

The same options give the same paths. The same command resumes an interrupted run; at most the units in progress are
lost. With one worker everything runs in this process; more are run by Ray, on this machine or on a cluster.

With --write-cases problems are only drawn, and written for machines without Pinocchio, Coal and OMPL; there --cases
solves them by trees and from random perturbations, and keeps the paths that the sphere cover proves free.

Usage: python scripts/generate_data.py FOLDER [--problems 10000] [--workers 2] [--address HOST:PORT] [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from apex_ompl.errors import ParameterError
from apex_ompl.paths.spline import Spline
from apex_ompl.training import generation
from apex_ompl.training.engine import EngineOptions
from apex_ompl.training.generation import Generation, Work
from apex_ompl.training.kernel_problems import load_kernel_problems, save_kernel_problems, solve_kernel_problems
from apex_ompl.training.store import Store
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import check_writable, make_folder
from apex_ompl.util.validation import one_or_more, whole_number

LATEST = 800_000  # from this seed on problems are not of the training split
# Pinocchio, Coal and OMPL are imported where problems are drawn: --cases needs none of them.


def generate(args: argparse.Namespace) -> None:
    """Solve the units that the data set lacks."""
    import zarr  # noqa: F401 - fails here where it is missing, and not after the first unit
    from tqdm import tqdm

    work = _read_units(args) if args.cases else _planned_units(args)
    options = EngineOptions(args.seed, args.copies, 0 if args.cases else args.parts, args.model)
    spline = Spline(args.control_points, args.pinned)
    known = Store(args.folder).units() if (Path(args.folder) / "manifest.json").is_file() else []
    there = len(set(work.units).intersection(known))
    with tqdm(total=len(work.units), initial=there, unit="unit", disable=args.quiet) as bar:

        def report(name: str, paths: int, seconds: float) -> None:
            bar.set_postfix_str(f"{paths / seconds:.1f} paths/s, {name}")
            bar.update()

        settings = Generation(options, spline, args.workers, args.address)
        done = generation.generate(Path(args.folder), work, settings, report)
    total, left = done.total, len(work.units) - there
    print(f"{args.folder}: {total['paths']} paths of {total['solved']} problems in {total['units']} units", end="")
    print(
        f"; {done.paths} of them now, {done.paths / done.seconds:.1f} a second" if left else "; nothing was left to do"
    )


def _planned_units(args: argparse.Namespace) -> Work:
    """Return units to draw."""
    from apex_ompl.collision import CollisionChecker
    from apex_ompl.problems.suite_robot import robot
    from apex_ompl.training.units import plan_units, solve_unit

    units = {unit.name: unit for unit in plan_units(args.problems, args.levels)}
    sizes = {unit.size for unit in units.values()}
    about = {"robot": robot().name, "joints": list(robot().joint_names), "problems_per_unit": max(sizes)}
    return Work(solve_unit, units, about, CollisionChecker(robot()).kernel.robot)


def _read_units(args: argparse.Namespace) -> Work:
    """Return the units of --cases.

    Raises:
        ParameterError: Suites are named as well, or problems are not to be trained with.
    """
    if args.levels:
        raise ParameterError("SUITE[/LEVEL]", " ".join(args.levels), "none beside --cases")
    units: dict[str, Any] = {}
    problems = load_kernel_problems(args.cases)
    others = [p.record.seed for p in problems if p.record.seed >= LATEST]
    if others:
        raise ParameterError(str(args.cases), others[0], f"problems to train with, whose seeds are below {LATEST}")
    for problem in problems:
        units.setdefault(problem.unit, []).append(problem)
    first, tables = problems[0], next((p.robot for p in problems if json.loads(p.record.held) == []), None)
    sizes = {len(unit) for unit in units.values()}
    about = {"robot": first.robot.name, "joints": list(first.robot.joint_names), "problems_per_unit": max(sizes)}
    return Work(solve_kernel_problems, units, about, tables)


def write_cases(args: argparse.Namespace) -> None:
    """Draw problems and write them for machines without Pinocchio.

    Raises:
        MissingFileError: The folder cannot be made.
    """
    from apex_ompl.training.units import kernel_problems, plan_units

    check_writable(make_folder(args.folder, "folder for problems") / "cases.npz")
    units = plan_units(args.problems, args.levels, args.split)
    problems = [problem for unit in units for problem in kernel_problems(unit)]
    save_kernel_problems(args.folder, problems)
    print(f"{args.folder}: {len(problems)} problems in {len({problem.unit for problem in problems})} units")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", metavar="FOLDER")
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]", help="by default all static levels, and broad")
    parser.add_argument(
        "--problems", type=one_or_more, default=10_000, help="about how many to draw (default: %(default)s)"
    )
    parser.add_argument("--seed", type=whole_number, default=0, help="seed of the choices (default: %(default)s)")
    parser.add_argument(
        "--copies", type=one_or_more, default=EngineOptions.copies, help="searches a problem (default: %(default)s)"
    )
    parser.add_argument(
        "--parts", type=whole_number, default=EngineOptions.parts, help="parts of each path (default: %(default)s)"
    )
    parser.add_argument("--model", default="", help="its proposals are tried first, for example apex (default: none)")
    parser.add_argument("--control-points", type=one_or_more, default=Spline.points, help="(default: %(default)s)")
    parser.add_argument("--pinned", type=one_or_more, default=Spline.pinned, help="at each end (default: %(default)s)")
    parser.add_argument(
        "--workers", type=one_or_more, default=1, help="processes, by Ray if several (default: %(default)s)"
    )
    parser.add_argument("--address", help="address of a Ray cluster, for example 10.0.0.1:6379, or auto")
    parser.add_argument("--write-cases", action="store_true", help="draw problems only, and write them to FOLDER")
    parser.add_argument(
        "--split", choices=("train", "validation"), default="train", help="for --write-cases (default: %(default)s)"
    )
    parser.add_argument("--cases", metavar="FOLDER", help="solve the problems that --write-cases wrote there")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    args = parser.parse_intermixed_args()  # suites may come after options
    if args.model and (args.cases or args.write_cases):
        parser.error("--model needs problems that are drawn here: leave out --cases and --write-cases")
    if args.split != "train" and not args.write_cases:
        parser.error("--split validation needs --write-cases: data sets are of the training split")
    write_cases(args) if args.write_cases else generate(args)


if __name__ == "__main__":
    run_script(main, "data")
