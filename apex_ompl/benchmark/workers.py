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

from apex_ompl.benchmark.rows import Job
from apex_ompl.benchmark.runs import CRASH, Run, run, told_of, unsolved, warm_up
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.util.cluster import spread
from apex_ompl.util.validation import check_integer

DIED = "the process died"
RENEWED = 500  # runs of a process, about, until another takes its place: OMPL's BIT* keeps 20 MB for each second


@dataclass(frozen=True)
class Workers:
    """Where runs are made.

    Attributes:
        at_once: Runs at the same time; their times are comparable with one.
        address: Of a Ray cluster; by default processes of this machine.
        modules: That are imported first, and register planners.
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

    def made(self, jobs: Sequence[Job], warm: dict[str, float]) -> Iterator[Run]:
        """Make runs, and yield them as they end; a process that dies is a run that crashed.

        Args:
            jobs: The runs to be made, in this order.
            warm: Is told how many seconds the first run of each row took, on this machine.

        Raises:
            ApexError: A planner kills the process while it warms up; a file, a parameter or a checkpoint is at
                fault; the cluster fails.
        """
        first = list({job.label: job for job in jobs}.values())
        if self.address is not None:
            named = {job.key: (job, first, self.modules) for job in jobs}

            def lost(key: str) -> Run:
                return told_of(named[key][0]) | unsolved(CRASH, DIED)

            found = spread(_remote, named, workers=self.at_once, address=self.address, ahead=1, lost=lost)
            yield from (one for _, one in found)
            return
        waiting, suspects, blamed = list(jobs[::-1]), list[Job](), set[str]()
        while waiting or suspects:  # those under way when a process died are made again, one by one
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
                for job in died:  # the first time it may have been the doing of a run before
                    if job.key in blamed:
                        yield told_of(job) | unsolved(CRASH, DIED)
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
        """Make runs of a queue, its end first, and take off what is under way, as long as processes last."""
        left = RENEWED * at_once
        while (queue and left) or under_way:
            while queue and left and len(under_way) < at_once:
                left -= 1
                under_way[pool.submit(_run, queue[-1])] = queue[-1]
                queue.pop()
            done, _ = wait(under_way, return_when=FIRST_COMPLETED)
            for future in done:
                one = future.result()
                del under_way[future]
                yield one


_warm_up: dict[str, float] = {}  # of this process
_faults: list[ApexError] = []


def _prepare(first: Sequence[Job], modules: Sequence[str]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits for runs goes by it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        _warm_up.update(warm_up(first, modules))
    except ApexError as error:  # said when there is somebody to hear it
        _faults.append(error)


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, were it killed."""
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
