"""Make the compact set of a data set: one file of all problems with as many of their paths as fit.

Complete paths come first, then reversals, then random parts. The robot's tables go beside it.

Usage: python scripts/compact_data.py FOLDER FILE.zip [--mib 24] [--seed 0]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from apex_ompl.training.records import PATH_FIELDS, SOURCES, DatasetError, Paths
from apex_ompl.training.store import Store, save
from apex_ompl.util.entry_point import run_script
from apex_ompl.util.files import check_writable, write_atomically
from apex_ompl.util.validation import whole_number

CLOSE = 200  # the size is within one part in this of its limit


def some(paths: Paths, count: int, seed: int) -> Paths:
    """Return a set with all problems and ``count`` of the paths."""
    rank = np.array([{"reversed": 1, "part": 2}.get(s, 0) for s in SOURCES])[paths.arrays["source"]]
    order = np.lexsort((np.random.default_rng(seed).random(len(paths)), rank))
    kept = np.sort(order[:count])
    arrays = {name: a[kept] if name in PATH_FIELDS else a for name, a in paths.arrays.items()}
    return Paths(arrays, paths.names, paths.about)


def compact(args: argparse.Namespace) -> None:
    """Write as many paths as fit."""
    check_writable(args.file)
    every, limit = Paths.concatenate(Store(args.folder)), args.mib * 2**20
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "trial.zip"
        fits, too_many, count = -1, len(every) + 1, len(every)
        while count > fits and too_many - fits > max(1, len(every) // CLOSE):
            save(trial, some(every, count, args.seed))
            size = trial.stat().st_size
            fits, too_many = (count, too_many) if size <= limit else (fits, count)
            count = (fits + too_many) // 2
        if fits < 0:
            raise DatasetError(f"{args.mib} MiB: the problems alone take more, expected a higher limit")
    chosen = some(every, fits, args.seed)
    save(args.file, chosen)
    if (args.folder / "robot.npz").is_file():
        write_atomically(args.file.parent / "robot.npz", (args.folder / "robot.npz").read_bytes())
    size = args.file.stat().st_size
    print(f"{args.file}: {len(chosen)} of {len(every)} paths, {chosen.problems} problems, {size / 2**20:.1f} MiB")


def mebibytes(text: str) -> float:
    """Read a size.

    Raises:
        ArgumentTypeError: It is none.
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a positive number of MiB")
    return value


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("file", type=Path, metavar="FILE.zip")
    parser.add_argument("--mib", type=mebibytes, default=24.0, help="largest size (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number, default=0, help="seed of the random choice (default: %(default)s)")
    args = parser.parse_args()
    compact(args)


if __name__ == "__main__":
    run_script(main, "data")
