"""Results of measurements, with their provenance: command, versions, hardware, commit, date, dependencies."""

from __future__ import annotations

import argparse
import ast
import json
import math
import platform
import sys
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl import problems
from apex_ompl.util import provenance
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import one_or_more

try:
    from apex_ompl.evaluation import Results
    from apex_ompl.evaluation.metrics import next_percentile
except ImportError as missing:
    expected = "pip install -c constraints.txt -e '.[bench]'"
    sys.exit(f"{Path(sys.argv[0]).stem}: error: no {missing.name}, expected: {expected}")

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks" / "results"
CHECKING = (
    "apex_ompl/scene", "apex_ompl/robot", "apex_ompl/kernel", "apex_ompl/collision", "apex_ompl/util",
    "apex_ompl/paths/path.py",
)  # fmt: skip
PLANNING = (
    *CHECKING, "apex_ompl/apex", "apex_ompl/api.py", "apex_ompl/model", "apex_ompl/ompl",
    "apex_ompl/planning", "apex_ompl/result.py", "apex_ompl/goals", "apex_ompl/paths", "planners", "problems",
)  # fmt: skip
GROUPS = {
    "@checking": CHECKING,
    "@planning": PLANNING,
    "@benchmark": (*PLANNING, "apex_ompl/evaluation", "apex_ompl/timing/smoothness.py"),
}
"""Names of groups of paths in ``DEPENDS``."""


def dependencies(script: Path, root: Path = ROOT) -> list[str]:
    """Return the paths that the results of a script depend on: the script, and its ``DEPENDS`` with groups resolved.

    The script is read, not run: some need packages that are not installed.

    Raises:
        SystemExit: It has no ``DEPENDS``, a tuple of texts.
    """
    for node in ast.parse(script.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["DEPENDS"]:
            declared = ast.literal_eval(node.value)
            paths = [path for name in declared for path in GROUPS.get(name, (name,))]
            return [script.resolve().relative_to(root).as_posix(), *dict.fromkeys(paths)]
    raise SystemExit(f"{script}: expected DEPENDS, the paths that its results depend on")


def script() -> Path:
    """Return the script that this process runs."""
    return Path(sys.argv[0]).resolve()


def _called(file: Path) -> str:
    """Return the command that runs a script: of a benchmark by its module, ``python -m benchmarks.planners.tune``."""
    relative = file.relative_to(ROOT)
    if relative.parts[0] != "benchmarks":
        return f"python {relative.as_posix()}"
    return f"python -m {'.'.join(relative.with_suffix('').parts)}"


def _shown(argument: str) -> str:
    """Return an argument as results name it: of a place on this machine the name alone."""
    return Path(argument).name if Path(argument).is_absolute() else argument


def parser(
    doc: str, n: int | None = None, of: str = "problems of a level", jobs: int | None = None
) -> argparse.ArgumentParser:
    """Return the parser of a benchmark, with ``-n`` and ``--jobs`` where their defaults are given.

    Args:
        doc: The module's docstring, whose first line is the description.
        n: Default of ``-n``.
        of: What is counted by ``-n``.
        jobs: Default of ``--jobs``: 1 where runs are timed.
    """
    found = argparse.ArgumentParser(description=doc.splitlines()[0])
    if n is not None:
        found.add_argument("-n", type=one_or_more, default=n, help=f"{of} (default: %(default)s)")
    if jobs is not None:
        found.add_argument("--jobs", type=one_or_more, default=jobs, help="runs at a time (default: %(default)s)")
    return found


def fastest(call: Callable[[], Any], repeats: int = 5) -> float:
    """Return the least time of a call among several [s]."""
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return min(times)


def session() -> dict[str, str]:
    """Return what a session of ``bench`` records besides its own provenance: the commit of what it depends on."""
    return {"commit": provenance.commit(ROOT, dependencies(script()))}


def write(
    name: str, data: dict[str, Any], table: str, folder: Path = RESULTS, **settings: Any
) -> None:  # fmt: skip
    """Write ``NAME.json`` and ``NAME.md``, and print the table.

    Args:
        name: Name of the measurement.
        data: The measured values, ready for JSON.
        table: Markdown tables of them.
        folder: Folder of the results.
        **settings: Seed, N and other settings; ``hardware`` where it is not that of this process.
    """
    depends = dependencies(script())
    about = {
        "command": " ".join([_called(script()), *map(_shown, sys.argv[1:])]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": provenance.commit(ROOT, depends),
        "hardware": provenance.hardware(),
        "python": platform.python_version(),
        "versions": provenance.versions(),
        "depends": depends,
        **settings,
    }
    folder.mkdir(exist_ok=True, parents=True)
    write_atomically(folder / f"{name}.json", (json.dumps({"about": about, **data}, indent=1) + "\n").encode())
    libraries = ", ".join(f"{k} {v}" for k, v in about["versions"].items())
    rest = ", ".join(f"{k} {v}" for k, v in settings.items() if k != "hardware")
    head = f"`{about['command']}` on {about['hardware']}; {about['date']}, commit {about['commit']}, "
    head += f"Python {about['python']}, {libraries}{'; ' if rest else ''}{rest}."
    write_atomically(folder / f"{name}.md", f"# {name}\n\n{head}\n\n{table}\n".encode())
    print(table)


def row(cells: list[Any]) -> str:
    """Return one row of a Markdown table."""
    return "| " + " | ".join(str(c) for c in cells) + " |"


def reached(values: list[float] | np.ndarray, p: float) -> float | None:
    """Return a percentile of times, the next larger value; None without any, or where it is infinite."""
    if not len(values):
        return None
    value = next_percentile(values, p)
    return value if math.isfinite(value) else None


def made_with(results: Results) -> dict[str, str]:
    """Return how the runs of results were made: number at a time, hardware, commits of the code."""
    sessions = results.sessions()
    names = {"jobs": "jobs", "hardware": "hardware", "run_commits": "commit"}
    return {name: _distinct(one.get(key, "unknown") for one in sessions) for name, key in names.items()}


def _distinct(values: Iterable[Any]) -> str:
    return "; ".join(sorted({str(value) for value in values}))


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
