"""What every committed measurement says besides its figures: command, versions, hardware, commit, date."""

from __future__ import annotations

import json
import math
import platform
import subprocess
import sys
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.benchmark.metrics import next_percentile
from apex_ompl.util.files import write_atomically
from apex_ompl.util.provenance import hardware, versions

RESULTS = Path(__file__).parent / "results"


def commit() -> str:
    """Return the commit of the tree, with a mark when it has changes."""
    root = Path(__file__).parent
    try:
        head = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=True
        )
        dirty = subprocess.run(["git", "status", "--porcelain"], cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head.stdout.strip() + ("+changes" if dirty.stdout.strip() else "")


def write(name: str, figures: dict[str, Any], table: str, **settings: Any) -> None:
    """Write ``results/NAME.json`` and ``results/NAME.md``, and print the table.

    Args:
        name: Name of the measurement.
        figures: The figures, ready for JSON.
        table: A Markdown table of them.
        **settings: Seed, N and other settings; ``hardware`` where it is not that of this process.
    """
    about = {
        "command": " ".join(
            [
                "python",
                *(str(a) for a in [Path(sys.argv[0]).name and f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
            ]
        ),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": commit(),
        "hardware": hardware(),
        "python": platform.python_version(),
        "versions": versions(),
        **settings,
    }
    RESULTS.mkdir(exist_ok=True)
    write_atomically(RESULTS / f"{name}.json", (json.dumps({"about": about, **figures}, indent=1) + "\n").encode())
    made_with = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    rest = ", ".join(f"{k} {v}" for k, v in settings.items() if k != "hardware")
    head = f"`{about['command']}` on {about['hardware']}; {about['date']}, commit {about['commit']}, "
    head += f"Python {about['python']}, {made_with}; {rest}."
    write_atomically(RESULTS / f"{name}.md", f"# {name}\n\n{head}\n\n{table}\n".encode())
    print(table)


def row(cells: list[Any]) -> str:
    """Return one row of a Markdown table."""
    return "| " + " | ".join(str(c) for c in cells) + " |"


def reached(values: list[float] | np.ndarray, p: float) -> float | None:
    """Return a percentile of times, the next larger value; None without any, or where it is endless."""
    if not len(values):
        return None
    value = next_percentile(values, p)
    return value if math.isfinite(value) else None


def made_with(runs: Iterable[dict[str, Any]]) -> dict[str, str]:
    """Return on what hardware runs of a store were made, and how many at a time."""
    runs = list(runs)
    return {name: "; ".join(sorted({str(run[name]) for run in runs})) for name in ("jobs", "hardware")}


def static_levels(wanted: list[str]) -> list[str]:
    """Return the suites' levels without moving obstacles, or those of them that are wanted: SUITE or SUITE/LEVEL.

    Raises:
        SystemExit: No such suite or level.
    """
    static = [f"{s}/{v}" for s, levels in problems.suites().items() for v in levels if not v.startswith("moving-")]
    chosen = [level for level in static if not wanted or level in wanted or level.split("/")[0] in wanted]
    if not set(wanted) <= {*static, *(level.split("/")[0] for level in static)}:
        raise SystemExit(f"unknown suite or level; known: {', '.join(static)}")
    return chosen


def percentiles(values: list[float] | np.ndarray, *which: float) -> list[float]:
    """Return percentiles of ``values``, NaN when there are none."""
    return [float(np.percentile(values, p)) if len(values) else float("nan") for p in which]
