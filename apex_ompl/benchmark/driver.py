"""A benchmark: runs kept as they end, so that it goes on where it was stopped."""

from __future__ import annotations

import importlib
import json
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from apex_ompl.api import check_arguments
from apex_ompl.benchmark.results import ABOUT, RUNS, SCHEMA, Results
from apex_ompl.benchmark.rows import Job, Row, jobs
from apex_ompl.benchmark.workers import Workers
from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.util.files import locked, make_folder, write_atomically
from apex_ompl.util.provenance import hardware, versions
from apex_ompl.util.resolution import FULL_RESOLUTION, SEARCH_RESOLUTION
from apex_ompl.util.validation import check_integer


def bench(
    suites: Sequence[str], rows: Sequence[Row | str], out: str | os.PathLike[str], *, runs: int = 100,
    timeout: float = 5.0, seed: int = 0, split: str = "test", simplify: bool = True, workers: Workers | None = None,
    quiet: bool = False,
) -> Results:  # fmt: skip
    """Run planners on problems through OMPL's Benchmark, in the same space, by the same checker and resolution.

    A run is solved when its path passed the full check. What was run before with the same settings is not run again.
    Every process has run each row once before its first run.

    Args:
        suites: Suites, levels, problems or files.
        rows: Planners.
        out: Folder for the results; it is made, or goes on.
        runs: Of each row on a level, each on another problem; or on a single problem.
        timeout: Of a run [s].
        seed: Of the first run; the next ones follow.
        split: Whose problems.
        simplify: Whether paths are shortened; those of smooth planners are not.
        workers: Where runs are made; by default one at a time, in a process of this machine.
        quiet: Whether to show no progress.

    Returns:
        The results in the folder.

    Raises:
        ApexError: An argument is unknown or out of range, the folder is of something else, or the cluster fails.
        KeyboardInterrupt: Ctrl-C was pressed; what had ended is kept.
    """
    workers = workers or Workers()
    check_arguments(timeout, seed)
    runs = check_integer(runs, "runs", 1)
    for module in workers.modules:
        importlib.import_module(module)
    given = [row if isinstance(row, Row) else Row.parse(row) for row in rows]
    wanted = jobs(suites, given, runs=runs, timeout=timeout, seed=seed, split=split, simplify=simplify)
    folder = make_folder(out)
    with locked(folder):
        if (folder / RUNS).exists() and not (folder / ABOUT).exists():
            raise FileFormatError(
                str(folder), "", f"{RUNS} without {ABOUT}", "expected results of bench, or no such file"
            )
        before = Results.load(folder) if (folder / ABOUT).exists() else Results(folder, {})
        settings = {"timeout": float(timeout), "seed": seed, "split": split, "simplify": simplify}
        about = _about(before.about, given, settings, folder)
        there = {one["key"] for one in before.runs}
        left = [job for job in wanted if job.key not in there]
        if not left:
            return before
        about["sessions"] = [*about["sessions"], _session(workers, split=split, seed=seed)]
        results = Results(folder, about, before.runs)
        results.note()
        try:
            _complete(results, left, len(wanted), workers, quiet)
        finally:
            results.note()
    return Results.load(folder)


def _session(workers: Workers, **more: Any) -> dict[str, Any]:
    """Return what is noted of one call."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name or "python", *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"), "hardware": hardware(), "jobs": workers.at_once,
        "address": workers.address or "", "python": platform.python_version(),
        "versions": versions(), **more,
    }  # fmt: skip


def _about(
    before: dict[str, Any], rows: Sequence[Row], settings: dict[str, Any], folder: Path
) -> dict[str, Any]:  # fmt: skip
    """Return what is noted of all calls.

    Raises:
        ParameterError: What is there was made otherwise.
    """
    for name, value in settings.items():
        there = before.get("settings", settings)[name]
        if there != value:
            raise ParameterError(name, value, f"{there!r}, as in {folder}; or another folder")
    known = {**before.get("rows", {})}
    for row in rows:
        now = {"planner": row.planner, "all": row.settings(), "timeout": row.timeout}
        if known.setdefault(row.label, now) != now:
            raise ParameterError("planner", row.label, f"the parameters that it has in {folder}; or another folder")
    return {
        "schema": SCHEMA, "settings": settings, "sessions": before.get("sessions", []), "rows": known,
        "resolution": {"search": SEARCH_RESOLUTION, "full": FULL_RESOLUTION}, "warm_up": before.get("warm_up", {}),
    }  # fmt: skip


def _complete(results: Results, left: Sequence[Job], of: int, workers: Workers, quiet: bool) -> None:
    """Make the runs that are left, and write each as it ends."""
    file = results.folder / RUNS
    if file.is_file() and not file.read_bytes().endswith(b"\n"):  # the process ended while it wrote
        write_atomically(file, "".join(json.dumps(one) + "\n" for one in results.runs).encode())
    solved = 0
    with file.open("a") as out, tqdm(total=of, initial=of - len(left), unit="run", disable=quiet) as bar:
        for done, one in enumerate(workers.made(left, results.about["warm_up"]), 1):
            out.write(json.dumps(one) + "\n")
            out.flush()
            solved += one["solved"]
            bar.set_postfix_str(f"{solved} of {done} solved, {one['experiment']} {one['label']}")
            bar.update()
