"""Time on the simulated clock: work is charged by counts and a table of costs, never by the machine's clock.

So the same seed gives the same run bit for bit, on a loaded machine too, and all ways of replanning have one budget.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from apex_ompl.errors import FileFormatError
from apex_ompl.util.schema import read_json

TABLE = Path(__file__).with_name("costs.json")


@cache
def cost_table(path: Path = TABLE) -> Mapping[str, Any]:
    """Return the table of costs: ``version``, and ``seconds`` by kind of work.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not such a table.
    """
    table = read_json(path, "table of costs")
    try:
        seconds = {str(kind): float(value) for kind, value in table["seconds"].items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileFormatError(str(path), "seconds", "not a table of costs", "expected seconds by kind") from error
    return {**table, "seconds": seconds}


@dataclass(eq=False)
class Charges:
    """What a piece of work has cost so far.

    Attributes:
        limit: Time that it may take [s].
        spent: Time that it took, by the table [s].
        counts: Number of units of work by kind.
    """

    limit: float
    spent: float = 0.0
    counts: Counter[str] = field(default_factory=Counter)

    def charge(self, kind: str, count: int = 1) -> None:
        """Charge units of a kind of work of the table."""
        self.counts[kind] += count
        self.spent += count * cost_table()["seconds"][kind]

    def over(self) -> bool:
        """Whether the time is used up."""
        return self.spent >= self.limit
