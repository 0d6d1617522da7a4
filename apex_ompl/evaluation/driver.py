"""Driver of a benchmark, and the processes that make its runs.

Each run is stored when it ends, so that a benchmark resumes where it was stopped.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import platform
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from apex_ompl.errors import ApexError, FileFormatError, ParameterError
from apex_ompl.evaluation.results import ABOUT, RUNS, SCHEMA, Results
from apex_ompl.evaluation.rows import Job, Row, jobs
from apex_ompl.evaluation.runs import CRASH, RESULT, Run, job_columns, run, unsolved, warm_up
from apex_ompl.paths.path import SEARCH_RESOLUTION
from apex_ompl.planning.options import check_arguments
from apex_ompl.util.cluster import spread
from apex_ompl.util.files import locked, make_folder, write_atomically
from apex_ompl.util.provenance import hardware, versions
from apex_ompl.util.validation import check_integer

DIED = "the process died"
RUNS_PER_PROCESS = 500  # about, until a new process replaces it: OMPL's BIT* leaks 20 MB for each second


@dataclass(frozen=True)
class Workers:
    """Where runs are executed.

    Attributes:
        at_once: Number of runs at the same time; with one, times are those of runs alone.
        address: Address of a Ray cluster; by default processes of this machine.
        modules: Modules to import first, which register planners.
    """

    at_once: int = 1
    address: str | None = None
    modules: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the number.

        Raises:
            ParameterError: It is not a whole number, 1 or more.
        """
        check_integer(self.at_once, "jobs", 1)

    def runs_of(self, jobs: Sequence[Job], warm: dict[str, float]) -> Iterator[Run]:
        """Make runs, and yield them as they end; a run whose process dies has crashed.

        Args:
            jobs: The runs to be made, in this order.
            warm: Filled with the time of the first run of each row on this machine [s].

        Raises:
            ApexError: A planner kills the process while it warms up; a file, a parameter or a checkpoint is
                faulty; the cluster fails.
        """
        first = list({job.label: job for job in jobs}.values())
        if self.address is not None:
            named = {job.key: (job, first, self.modules) for job in jobs}

            def lost(key: str) -> Run:
                return job_columns(named[key][0]) | unsolved(CRASH, DIED)

            found = spread(_remote, named, workers=self.at_once, address=self.address, ahead=1, lost=lost)
            yield from (one for _, one in found)
            return
        waiting, suspects, blamed = list(jobs[::-1]), list[Job](), set[str]()
        while waiting or suspects:  # runs in progress when a process died are repeated one by one
            under_way: dict[Future[Run], Job] = {}
            before = len(waiting) + len(suspects)
            pool = self._pool(first, 1 if suspects else self.at_once)
            try:
                warm.update(pool.submit(_warm_up_seconds).result())
                yield from self._pooled(pool, suspects or waiting, 1 if suspects else self.at_once, under_way)
            except BrokenProcessPool:
                died = list(under_way.values())
                if not died and len(waiting) + len(suspects) == before:
                    raise ParameterError(
                        "planners", ", ".join(job.label for job in first), "planners that do not end the process"
                    ) from None
                for job in died:  # at the first death another run may be the cause
                    if job.key in blamed:
                        yield job_columns(job) | unsolved(CRASH, DIED)
                    else:
                        blamed.add(job.key)
                        suspects.append(job)
            finally:
                pool.shutdown(cancel_futures=True)

    def _pool(self, first: Sequence[Job], workers: int) -> ProcessPoolExecutor:
        spawn = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(workers, spawn, initializer=_prepare, initargs=(first, self.modules))

    @staticmethod
    def _pooled(
        pool: ProcessPoolExecutor, queue: list[Job], at_once: int, under_way: dict[Future[Run], Job]
    ) -> Iterator[Run]:
        """Make runs from the end of a queue until the processes are due for renewal; those started leave the queue."""
        left = RUNS_PER_PROCESS * at_once
        while (queue and left) or under_way:
            while queue and left and len(under_way) < at_once:
                left -= 1
                under_way[pool.submit(_run, queue[-1])] = queue[-1]
                queue.pop()
            done, _ = wait(under_way, return_when=FIRST_COMPLETED)
            for future in done:
                made = future.result()
                del under_way[future]
                yield made


_warm_up: dict[str, float] = {}  # of this process
_faults: list[ApexError] = []


def _prepare(first: Sequence[Job], modules: Sequence[str]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent process handles it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _warm_up.update(warm_up(first, modules))
    except ApexError as error:  # raised by the first call, for the parent to catch
        _faults.append(error)


def _end_with_parent() -> None:
    """End this process when its parent has ended, even by SIGKILL."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _warm_up_seconds() -> dict[str, float]:
    if _faults:
        raise _faults[0]
    return _warm_up


def _run(job: Job) -> Run:
    if _faults:
        raise _faults[0]
    return run(job)


def _remote(job: Job, first: Sequence[Job], modules: Sequence[str]) -> Run:
    """Make a run on a worker of a cluster."""
    if not _warm_up:
        _warm_up.update(warm_up(first, modules))
    return run(job)


def bench(
    suites: Sequence[str], rows: Sequence[Row | str], out: str | os.PathLike[str], *, runs: int = 100,
    timeout: float = 5.0, seed: int = 0, split: str = "test", simplify: bool = True, workers: Workers | None = None,
    keep: bool = False, quiet: bool = False, provenance: Mapping[str, Any] | None = None, first: int = 0,
) -> Results:  # fmt: skip
    """Run planners on problems through OMPL's Benchmark, with the same space, checker and resolution.

    A run is solved when its path passed the full check. Runs that the folder holds with the same settings are not
    repeated. Each process makes one run of each row to warm up.

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
        first: Number of problems at the start of each level that are left out.

    Returns:
        The results in the folder.

    Raises:
        ApexError: An argument is unknown or out of range, the folder holds other files, or the cluster fails.
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
