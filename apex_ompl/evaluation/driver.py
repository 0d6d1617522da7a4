"""Driver of a benchmark: each run is stored when it ends, so that a benchmark resumes where it was stopped."""

from __future__ import annotations

import importlib
import json
import os
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.evaluation.results import ABOUT, RUNS, SCHEMA, Results
from apex_ompl.evaluation.rows import Job, Row, jobs
from apex_ompl.evaluation.runs import RESULT
from apex_ompl.evaluation.workers import Workers
from apex_ompl.planning.planner import check_arguments
from apex_ompl.util.files import locked, make_folder, write_atomically
from apex_ompl.util.provenance import hardware, versions
from apex_ompl.util.resolution import SEARCH_RESOLUTION
from apex_ompl.util.validation import check_integer


def bench(
    suites: Sequence[str], rows: Sequence[Row | str], out: str | os.PathLike[str], *, runs: int = 100,
    timeout: float = 5.0, seed: int = 0, split: str = "test", simplify: bool = True, workers: Workers | None = None,
    keep: bool = False, quiet: bool = False, provenance: Mapping[str, Any] | None = None, first: int = 0,
) -> Results:  # fmt: skip
    """Run planners on problems through OMPL's Benchmark, with the same space, checker and resolution.

    A run is solved when its path passed the full check. Runs that the folder has with the same settings are not made
    again. Each process makes one run of each row to warm up.

    Args:
        suites: Suites, levels, problems or files.
        rows: Planners.
        out: Folder of the results, which is made or resumed.
        runs: Number of runs of each row on a level, each on another problem, or on a single problem.
        timeout: Time limit of a run [s].
        seed: Seed of the run on the first problem of a level; that on the k-th one has ``seed + k``.
        split: Split of the problems.
        simplify: Whether paths are simplified; those of smooth planners are not.
        workers: Where runs are made; by default one at a time, in a process of this machine.
        keep: Whether to store the result of each run that is made by ``plan``, for ``PlanResult.load``.
        quiet: Whether to show no progress.
        provenance: Further entries of the session, as the commit of the code.
        first: Number of problems of each level that are left out before.

    Returns:
        The results in the folder.

    Raises:
        ApexError: An argument is unknown or out of range, the folder is of something else, or the cluster fails.
        KeyboardInterrupt: Ctrl-C was pressed; runs that had ended are kept.
    """
    workers = workers or Workers()
    check_arguments(timeout, seed)
    runs = check_integer(runs, "runs", 1)
    for module in workers.modules:
        importlib.import_module(module)
    parsed = [row if isinstance(row, Row) else Row.parse(row) for row in rows]
    wanted = jobs(suites, parsed, runs=runs, timeout=timeout, seed=seed, split=split, simplify=simplify, first=first)
    folder = make_folder(out)
    with locked(folder):
        if (folder / RUNS).exists() and not (folder / ABOUT).exists():
            raise FileFormatError(
                str(folder), "", f"{RUNS} without {ABOUT}", "expected results of bench, or no such file"
            )
        before = Results.load(folder) if (folder / ABOUT).exists() else Results(folder, {})
        settings = {"timeout": float(timeout), "seed": seed, "split": split, "simplify": simplify}
        about = _about(before.about, parsed, settings, folder)
        stored = {run["key"] for run in before.runs}
        left = [job for job in wanted if job.key not in stored]
        if not left:
            return before
        session = _session(workers, split=split, seed=seed, **(provenance or {}))
        about["sessions"] = [*about["sessions"], session]
        results = Results(folder, about, before.runs)
        results.save_about()
        try:
            _complete(results, left, len(wanted), workers, keep=keep, quiet=quiet)
        finally:
            results.save_about()
    return Results.load(folder)


def _session(workers: Workers, **more: Any) -> dict[str, Any]:
    """Return the provenance of one call of ``bench``."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name or "python", *sys.argv[1:]]),
        "date": datetime.now(UTC).isoformat(timespec="seconds"), "hardware": hardware(), "jobs": workers.at_once,
        "address": workers.address or "", "python": platform.python_version(),
        "versions": versions(), **more,
    }  # fmt: skip


def _about(
    before: dict[str, Any], rows: Sequence[Row], settings: dict[str, Any], folder: Path
) -> dict[str, Any]:  # fmt: skip
    """Return the provenance of all calls.

    Raises:
        ParameterError: The results in the folder have other settings.
    """
    for name, value in settings.items():
        stored = before.get("settings", settings)[name]
        if stored != value:
            raise ParameterError(name, value, f"{stored!r}, as in {folder}; or another folder")
    known = {**before.get("rows", {})}
    for row in rows:
        now = {"planner": row.planner, "all": row.settings(), "timeout": row.timeout}
        now |= {"runner": row.runner} if row.runner else {}
        if known.setdefault(row.label, now) != now:
            raise ParameterError("planner", row.label, f"the parameters that it has in {folder}; or another folder")
    return {
        "schema": SCHEMA, "settings": settings, "sessions": before.get("sessions", []), "rows": known,
        "resolution": before.get("resolution", {"search": SEARCH_RESOLUTION}), "warm_up": before.get("warm_up", {}),
    }  # fmt: skip


def _complete(
    results: Results, left: Sequence[Job], of: int, workers: Workers, *, keep: bool, quiet: bool
) -> None:  # fmt: skip
    """Make the runs that are left, and write each when it ends."""
    file = results.folder / RUNS
    if file.is_file() and not file.read_bytes().endswith(b"\n"):  # a killed process left an incomplete line
        write_atomically(file, "".join(json.dumps(run) + "\n" for run in results.runs).encode())
    solved, session = 0, len(results.about["sessions"]) - 1
    with file.open("a") as out, tqdm(total=of, initial=of - len(left), unit="run", disable=quiet) as bar:
        for done, run in enumerate(workers.runs_of(left, results.about["warm_up"]), 1):
            made = run.pop(RESULT, None)
            if keep and made is not None:
                plan_file = results.plan_file(run)
                make_folder(plan_file.parent)
                made.save(plan_file)
            out.write(json.dumps({**run, "session": session}) + "\n")
            out.flush()
            solved += run["solved"]
            bar.set_postfix_str(f"{solved} of {done} solved, {run['experiment']} {run['label']}")
            bar.update()
