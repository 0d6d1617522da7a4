"""Copy a training run's checkpoint into the package, where ``apex_ompl.load_model(NAME)`` finds it.

Usage: python scripts/export_checkpoint.py RUN NAME [--bits 16]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Literal

from apex_ompl.util.entry_point import run_script

LARGEST = 24.0  # of all that ship together [MiB]


def export(run: Path, name: str, bits: Literal[8, 16]) -> None:
    """Read and check the checkpoint of a run, and write it."""
    from apex_ompl.model.checkpoint import SHIPPED
    from apex_ompl.training.torch_model import load_torch_model, save_model

    folder = run / "checkpoint" if (run / "checkpoint").is_dir() else run
    model = load_torch_model(folder)
    save_model(SHIPPED / name, model.network, model.about, bits=bits)
    size = sum(file.stat().st_size for file in SHIPPED.glob("*/*")) / 2**20
    print(f"{name}: {model.about.get('phase')}, step {model.about.get('step')}; {size:.1f} MiB ship together")
    if size > LARGEST:
        print(f"export_checkpoint: note: expected at most {LARGEST:g} MiB together", file=sys.stderr)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a training run, or a checkpoint")
    parser.add_argument("name", metavar="NAME", help="name of the checkpoint, for example apex")
    parser.add_argument("--bits", type=int, choices=(8, 16), default=16, help="bits of a weight (default: %(default)s)")
    args = parser.parse_args()
    export(args.run, args.name, args.bits)


if __name__ == "__main__":
    run_script(main)
