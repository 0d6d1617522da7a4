"""Provenance of measurements and data sets: versions of libraries, and hardware."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from apex_ompl.util.process import usable_cores

FIGURES = ("apex-ompl", "ompl", "pin", "coal", "numba", "numpy", "torch")
"""Libraries that affect measurements."""
LIBRARIES = (*FIGURES, "ruckig", "scipy", "pydantic", "example-robot-data")


def versions(libraries: Sequence[str] = FIGURES) -> dict[str, str]:
    """Return name -> version of those libraries that are installed."""
    found = {}
    for name in libraries:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def commit(root: Path, paths: Sequence[str] = (".",)) -> str:
    """Return the commit of a git repository, with ``+changes`` where some paths of it differ; or ``unknown``."""
    commands = (["rev-parse", "--short", "HEAD"], ["status", "--porcelain", "--", *paths])
    try:
        head, changes = (
            subprocess.run(["git", *command], cwd=root, capture_output=True, text=True, check=True).stdout.strip()
            for command in commands
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+changes" if changes else "")


def hardware() -> str:
    """Return the name of the processor and the number of cores available to this process."""
    name, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.exists():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        name = names[0] if names else name
    return f"{name}, {len(usable_cores())} cores"
