"""Make the compact set of a data set: one file of all problems with as many of their paths as fit.

Whole paths come first, then reversals, then random parts.

Usage: python scripts/compact_data.py FOLDER FILE.zip [--mib 24] [--seed 0]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from apex_ompl.dataset import PATH_FIELDS, SOURCES, DatasetError, Paths, Store, save
from apex_ompl.errors import ApexError
from apex_ompl.files import check_writable

TRIES = 6
SLACK = 0.98


def some(paths: Paths, count: int, rng: np.random.Generator) -> Paths:
    """Return a set with all problems and ``count`` of the paths."""
    rank = np.array([{"reversed": 1, "part": 2}.get(s, 0) for s in SOURCES])[paths.arrays["source"]]
    order = np.lexsort((rng.random(len(paths)), rank))
    kept = np.sort(order[:count])
    arrays = {name: a[kept] if name in PATH_FIELDS else a for name, a in paths.arrays.items()}
    return Paths(arrays, paths.names, {})


def compact(args: argparse.Namespace) -> None:
    """Write as many paths as fit."""
    check_writable(args.file)
    whole, limit = Paths.joined(Store(args.folder)), args.mib * 2**20
    count = len(whole)
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(TRIES):
            trial = Path(folder) / "trial.zip"
            chosen = some(whole, count, np.random.default_rng(args.seed))
            save(trial, chosen)
            size = trial.stat().st_size
            if size <= limit:
                break
            count = int(count * limit / size * SLACK)
        else:
            raise DatasetError(f"{args.mib} MiB: even {len(chosen)} paths take more, expected a higher limit")
    save(args.file, chosen)
    print(f"{args.file}: {len(chosen)} of {len(whole)} paths, {chosen.problems} problems, {size / 2**20:.1f} MiB")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("file", type=Path, metavar="FILE.zip")
    parser.add_argument("--mib", type=float, default=24.0, help="largest size (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the random choice (default: %(default)s)")
    args = parser.parse_args()
    try:
        compact(args)
    except ApexError as error:
        print(f"compact_data: error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
