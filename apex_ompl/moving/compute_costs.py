"""Compute-cost model: on the simulated clock, work takes counts of operations times measured costs.

The machine's own clock is not read, so that the same seed gives the same run bit for bit, on a loaded machine too, and
all replanners have the same budget. On the wall clock, work takes the time that passes.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from apex_ompl.errors import FileFormatError
from apex_ompl.util.schema import read_json

POLLED = 5e-4  # time between two checks whether a request is superseded, which cost 20 us each [s]
TABLE = Path(__file__).with_name("costs.json")


@cache
def cost_table(path: Path = TABLE) -> Mapping[str, Any]:
    """Return the table of compute costs: ``version``, and ``seconds`` by kind of work.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not such a table.
    """
    table = read_json(path, "table of costs")
    try:
        seconds = {str(kind): float(value) for kind, value in table["seconds"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileFormatError(str(path), "seconds", "not a compute-cost table", "expected seconds by kind") from error
    return {**table, "seconds": seconds}


@dataclass(eq=False)
class ComputeBudget:
    """Time that a piece of work may take, and what it took so far.

    Attributes:
        limit: Time that it may take [s].
        spent: Time that it took by the compute-cost table [s].
        counts: Number of units of work by kind.
    """

    limit: float
    spent: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)

    def spend(self, kind: str, count: int = 1) -> None:
        """Add units of a kind of work of the compute-cost table."""
        self.counts[kind] += count
        self.spent += count * cost_table()["seconds"][kind]

    def over(self) -> bool:
        """Whether the time is used up."""
        return self.spent >= self.limit


def _never() -> bool:
    return False


class WallClockBudget(ComputeBudget):
    """Budget by the wall clock, from its construction on."""

    def __init__(self, limit: float, superseded: Callable[[], bool] = _never) -> None:
        """Start now.

        Args:
            limit: Time that the work may take [s].
            superseded: Returns whether a newer request makes the work useless.
        """
        super().__init__(limit)
        self._started, self._superseded, self._polled = time.perf_counter(), superseded, 0.0

    def __getstate__(self) -> dict[str, Any]:
        """Return what is sent with an answer: its numbers."""
        return {**vars(self), "_superseded": _never}

    def spend(self, kind: str, count: int = 1) -> None:
        """Count units of work, and read the clock."""
        self.counts[kind] += count
        self.spent = time.perf_counter() - self._started

    def over(self) -> bool:
        """Whether the time is used up."""
        self.spent = time.perf_counter() - self._started
        if super().over():
            return True
        if self.spent < self._polled + POLLED:
            return False
        self._polled = self.spent
        return self._superseded()
