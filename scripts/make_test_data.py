"""Draw the small data set of the tests, tests/data/dual_panda_softhand, from the one in data/dual_panda_softhand.

It holds the paths of every 60th problem, every fourth hard validation problem, and the tables of the robot.

Usage: python scripts/make_test_data.py [--source data/dual_panda_softhand] [--out tests/data/dual_panda_softhand]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from apex_ompl.training.kernel_problems import load_kernel_problems, save_kernel_problems
from apex_ompl.training.store import load, save
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import make_folder, write_atomically

PROBLEM_STRIDE, CASE_STRIDE = 60, 4
EASY_SUITE = "bins"  # repairing the straight line solves most of its problems, so they hardly distinguish models


def make(source: Path, out: Path) -> None:
    """Write the subset.

    Raises:
        ApexError: The source cannot be read, or the folder cannot be written.
    """
    make_folder(out, "folder for the data of the tests")
    full = load(source / "paths.zip")
    paths = full.subset(np.arange(0, full.problems, PROBLEM_STRIDE))
    save(out / "paths.zip", paths)
    hard = [
        case
        for case in load_kernel_problems(source / "validation")
        if case.level == "hard" and case.suite != EASY_SUITE
    ]
    cases = hard[::CASE_STRIDE]
    save_kernel_problems(out / "validation", cases)
    write_atomically(out / "robot.npz", (source / "robot.npz").read_bytes())
    size = sum(file.stat().st_size for file in out.rglob("*.*") if file.is_file())
    print(f"{out}: {len(paths)} paths of {paths.problems} problems, {len(cases)} cases, {size / 2**10:.0f} KiB")


def main() -> None:
    """Read the command line."""
    root = Path(__file__).resolve().parent.parent
    name = "dual_panda_softhand"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", type=Path, default=root / "data" / name, help="full set (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=root / "tests" / "data" / name, help="default: %(default)s")
    args = parser.parse_args()
    make(args.source, args.out)


if __name__ == "__main__":
    run_script(main, "data")
