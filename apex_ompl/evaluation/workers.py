"""Processes that make the runs of a benchmark."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.evaluation.rows import Job
from apex_ompl.evaluation.runs import CRASH, Run, job_columns, run, unsolved, warm_up
from apex_ompl.util.cluster import spread
from apex_ompl.util.validation import check_integer

DIED = "the process died"
RUNS_PER_PROCESS = 500  # about, until a new process takes its place: OMPL's BIT* leaks 20 MB for each second


@dataclass(frozen=True)
class Workers:
    """Where runs are made.

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
            ApexError: A planner kills the process while it warms up; a file, a parameter or a checkpoint is at
                fault; the cluster fails.
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
        while waiting or suspects:  # runs under way when a process died are made again, one by one
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
                for job in died:  # the first time another run may have been the cause
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
    """End this process when its parent has ended, were it by SIGKILL."""
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
