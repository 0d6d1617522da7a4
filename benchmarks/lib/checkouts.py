"""Another checkout of this project, whose code runs in a process of its own beside this one's."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from apex_ompl.util import provenance


def add_checkout(parser: argparse.ArgumentParser) -> None:
    """Add the argument ``folder``: the checkout that is 'before'."""
    parser.add_argument("folder", type=_checkout, help="another checkout, which is 'before'")


def _checkout(given: str) -> Path:
    """Return a checkout's folder.

    Raises:
        argparse.ArgumentTypeError: It is none.
    """
    folder = Path(given).resolve()
    if not (folder / "apex_ompl" / "__init__.py").is_file():
        expected = "expected a folder with apex_ompl/__init__.py"
        raise argparse.ArgumentTypeError(f"{given} is no checkout of this project: {expected}")
    return folder


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a process that runs a checkout's code on one thread."""
    return os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


def commit(folder: Path) -> str:
    """Return the commit of a checkout's code."""
    return provenance.commit(folder, ["apex_ompl"])
