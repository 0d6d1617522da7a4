"""Runs of a benchmark on a pool of processes, kept as they end, so that a command goes on where it was stopped."""

from __future__ import annotations

import json
import multiprocessing
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from apex_ompl.util.provenance import hardware

EVERY = 500  # runs between two lines about how far it is


class RunStore:
    """Runs as JSON lines in a file.

    Attributes:
        path: The file.
        keys: The entries by which runs are told apart.
    """

    def __init__(self, path: Path, keys: Sequence[str]) -> None:
        """Keep runs in a file; it is made when the first run ends."""
        self.path, self.keys = path, tuple(keys)

    def read(self) -> dict[tuple[Any, ...], dict[str, Any]]:
        """Return the runs by their keys."""
        found = {}
        for line in self.path.read_text().splitlines() if self.path.is_file() else []:
            try:
                run = json.loads(line)
                found[tuple(run[key] for key in self.keys)] = run
            except (json.JSONDecodeError, KeyError):  # the process ended while it wrote
                continue
        return found

    def complete(
        self, run: Callable[[Any], dict[str, Any]], jobs: Sequence[Any], workers: int,
        warm_up: Callable[..., None], *given: Any,
    ) -> None:  # fmt: skip
        """Do jobs, and write what comes of them, with the number of processes and the hardware.

        Args:
            run: Does one.
            jobs: What it is called with.
            workers: Processes.
            warm_up: Called in each process with ``given`` before its first run.
            *given: For ``warm_up``.

        Raises:
            SystemExit: Some raised, which are named, and left for another time.
        """
        if not jobs:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.is_file() and not self.path.read_bytes().endswith(b"\n"):  # the process ended while it wrote
            self.path.write_text(self.path.read_text() + "\n")
        spawn = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, spawn, initializer=warm_up, initargs=given)
        failed = 0
        with self.path.open("a") as out:
            futures = {pool.submit(run, job): job for job in jobs}
            try:
                for k, future in enumerate(as_completed(futures)):
                    if future.exception() is None:
                        out.write(json.dumps({**future.result(), "jobs": workers, "hardware": hardware()}) + "\n")
                        out.flush()
                    else:
                        failed += 1
                        print(f"{futures[future]}: {future.exception()!r}", file=sys.stderr, flush=True)
                    if (k + 1) % EVERY == 0:
                        print(f"{k + 1} of {len(jobs)} runs", flush=True)
            finally:
                pool.shutdown(cancel_futures=True)
        if failed:
            raise SystemExit(f"{failed} of {len(jobs)} runs failed; what has ended is kept in {self.path}")
