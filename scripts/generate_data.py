"""Make a data set of proven paths: problems of the training split are drawn, solved, and what was proved is kept.

The same options give the same paths. What was stopped goes on when the command is given again; at most the units under
way are lost. With one worker everything runs in this process; more are run by Ray, on this machine or on a cluster.

With --write-cases problems are drawn only, and written for machines without Pinocchio, Coal and OMPL; there --cases
solves them from the straight line and from bumps, and keeps what the spheres prove.

Usage: python scripts/generate_data.py FOLDER [--problems 10000] [--workers 2] [--address HOST:PORT] [SUITE[/LEVEL] ...]
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from apex_ompl.datasets.cases import load_cases, save_cases, work_cases
from apex_ompl.datasets.engine import Options
from apex_ompl.datasets.records import Paths
from apex_ompl.datasets.store import Store
from apex_ompl.errors import ParameterError
from apex_ompl.kernel import RobotTables
from apex_ompl.trajopt.spline import Spline
from apex_ompl.util.cluster import spread
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import check_writable, make_folder
from apex_ompl.util.provenance import versions
from apex_ompl.util.validation import one_or_more, whole_number

# Pinocchio, Coal and OMPL are imported where problems are drawn: --cases needs none of them.

LIBRARIES = ("apex-ompl", "ompl", "pin", "coal", "numba", "numpy", "zarr")
Work = Callable[[Any, Options, Spline], tuple[Paths, dict[str, float]]]
Done = tuple[str, Paths, dict[str, float]]


def worked(
    work: Work, units: dict[str, Any], options: Options, spline: Spline, *, workers: int, address: str | None
) -> Iterator[Done]:
    """Work on units by their names: in this process, or where there are several workers or a cluster by Ray.

    Raises:
        ClusterError: Ray is not there, or a worker failed.
    """
    if not units or (workers == 1 and address is None):
        for name, unit in units.items():
            yield name, *work(unit, options, spline)
        return
    jobs = {name: (unit, options, spline) for name, unit in units.items()}
    for name, (paths, times) in spread(work, jobs, workers=workers, address=address):
        yield name, paths, times


def generate(args: argparse.Namespace) -> None:
    """Make what is missing of the data set."""
    import tqdm  # noqa: F401 - said now if it is missing, and not behind the first unit
    import zarr  # noqa: F401

    spline = Spline(args.control_points, args.pinned)
    work, units, about, tables = _given(args) if args.cases else _drawn(args)
    options = Options(args.seed, args.copies, 0 if args.cases else args.parts, args.model)
    manifest = {
        **about, "seed": args.seed, "copies": args.copies,
        "parts": options.parts, "model": args.model, "control_points": args.control_points, "pinned": args.pinned,
        "degree": spline.degree,
        "split": "train", "python": platform.python_version(),
        "versions": versions(LIBRARIES),
    }  # fmt: skip
    same = (
        "robot",
        "joints",
        "seed",
        "copies",
        "parts",
        "model",
        "control_points",
        "pinned",
        "degree",
        "problems_per_unit",
    )
    store = Store.create(args.folder, manifest, same)
    with store.locked():
        if tables is not None:
            tables.save(store.folder / "robot.npz")
        there = set(store.units())
        left = {name: unit for name, unit in units.items() if name not in there}
        source = worked(work, left, options, spline, workers=args.workers, address=args.address)
        paths, seconds = _make(store, source, len(units), len(left), args)
        total = summary(store)
        store.note(counts=total)
    print(f"{args.folder}: {total['paths']} paths of {total['solved']} problems in {total['units']} units", end="")
    print(f"; {paths} of them now, {paths / seconds:.1f} a second" if left else "; nothing was left to do")


def _make(store: Store, source: Iterator[Done], units: int, left: int, args: argparse.Namespace) -> tuple[int, float]:
    """Write what is made, and note the run; return how many paths it made, and in how many seconds."""
    from tqdm import tqdm

    begin, done, paths, times = time.perf_counter(), 0, 0, Counter[str]()
    seconds = 0.0
    try:
        with tqdm(total=units, initial=units - left, unit="unit", disable=args.quiet) as bar:
            for name, found, spent in source:
                store.write(name, found)
                done, paths = done + 1, paths + len(found)
                times.update(spent)
                rate = paths / (time.perf_counter() - begin)
                bar.set_postfix_str(f"{rate:.1f} paths/s, {name}")
                bar.update()
    finally:
        source.close()
        seconds = time.perf_counter() - begin
        if done:
            run = {"workers": args.workers, "seconds": round(seconds, 1), "units": done, "paths": paths}
            run["worker_seconds"] = {stage: round(value, 1) for stage, value in sorted(times.items())}
            store.note(runs=[*store.manifest.get("runs", []), run])
    return paths, max(seconds, 1e-9)


def _drawn(args: argparse.Namespace) -> tuple[Work, dict[str, Any], dict[str, Any], RobotTables]:
    """Return what works, units to draw, what the manifest says of the robot, and its tables with empty hands."""
    from apex_ompl.collision import CollisionChecker
    from apex_ompl.generation.worker import plan_units, work
    from apex_ompl.problems.suite_robot import robot

    units = {unit.name: unit for unit in plan_units(args.problems, args.levels)}
    sizes = {unit.size for unit in units.values()}
    about = {"robot": robot().name, "joints": list(robot().joint_names), "problems_per_unit": max(sizes)}
    return work, units, about, CollisionChecker(robot()).kernel.robot


def _given(args: argparse.Namespace) -> tuple[Work, dict[str, Any], dict[str, Any], RobotTables | None]:
    """Return what works, units that were written, what the manifest says of the robot, and its tables if known.

    Raises:
        ParameterError: Suites are named beside.
    """
    if args.levels:
        raise ParameterError("SUITE[/LEVEL]", " ".join(args.levels), "none beside --cases")
    units: dict[str, Any] = {}
    cases = load_cases(args.cases)
    for case in cases:
        units.setdefault(case.unit, []).append(case)
    first, tables = cases[0], next((case.robot for case in cases if json.loads(case.row.held) == []), None)
    sizes = {len(unit) for unit in units.values()}
    about = {"robot": first.robot.name, "joints": list(first.robot.joint_names), "problems_per_unit": max(sizes)}
    return work_cases, units, about, tables


def write_cases(args: argparse.Namespace) -> None:
    """Draw problems and write them for machines without Pinocchio.

    Raises:
        MissingFileError: The folder cannot be made.
    """
    from apex_ompl.generation.worker import plan_units, written

    check_writable(make_folder(args.folder, "folder for problems") / "cases.npz")
    units = plan_units(args.problems, args.levels, args.split)
    cases = [case for unit in units for case in written(unit)]
    save_cases(args.folder, cases)
    print(f"{args.folder}: {len(cases)} problems in {len({case.unit for case in cases})} units")


def summary(store: Store) -> dict[str, Any]:
    """Return what a data set holds, by counting."""
    total: Counter[str] = Counter(units=0, paths=0, solved=0)
    for paths in store:
        total.update({"units": 1, "paths": len(paths)})
        total.update({key: n for key, n in paths.counts.items() if isinstance(n, int)})
        total["unsolved"] += len(paths.counts.get("unsolved", ()))
    return dict(total)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", metavar="FOLDER")
    parser.add_argument("levels", nargs="*", metavar="SUITE[/LEVEL]", help="by default all static ones, and broad")
    parser.add_argument(
        "--problems", type=one_or_more, default=10_000, help="how many to draw, about (default: %(default)s)"
    )
    parser.add_argument("--seed", type=whole_number, default=0, help="of the random choices (default: %(default)s)")
    parser.add_argument(
        "--copies", type=one_or_more, default=Options.copies, help="paths sought (default: %(default)s)"
    )
    parser.add_argument(
        "--parts", type=whole_number, default=Options.parts, help="parts of each path (default: %(default)s)"
    )
    parser.add_argument("--model", default="", help="whose proposals are tried first, for example apex (default: none)")
    parser.add_argument("--control-points", type=one_or_more, default=Spline.points, help="(default: %(default)s)")
    parser.add_argument("--pinned", type=one_or_more, default=Spline.pinned, help="at each end (default: %(default)s)")
    parser.add_argument(
        "--workers", type=one_or_more, default=1, help="more than one are run by Ray (default: %(default)s)"
    )
    parser.add_argument("--address", help="of a Ray cluster, for example 10.0.0.1:6379, or auto")
    parser.add_argument("--write-cases", action="store_true", help="draw problems only, and write them to FOLDER")
    parser.add_argument(
        "--split", choices=("train", "validation"), default="train", help="of --write-cases (default: %(default)s)"
    )
    parser.add_argument("--cases", metavar="FOLDER", help="solve the problems that --write-cases wrote there")
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    args = parser.parse_args()
    if args.model and (args.cases or args.write_cases):
        parser.error("--model goes with problems that are drawn here")
    if args.split != "train" and not args.write_cases:
        parser.error("--split validation goes with --write-cases: data are of the training split")
    write_cases(args) if args.write_cases else generate(args)


if __name__ == "__main__":
    run_script(main, "data")
