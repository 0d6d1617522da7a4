"""Cells and tables of the page: numbers of results with their intervals."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.lib import record

MISSING = "not measured yet"
PREFIX = "paper_"
Where = tuple[str, ...]
"""Name of a result without ``paper_``, and the keys to an entry of it."""


class Results:
    """The results of the figures in a folder."""

    def __init__(self, folder: Path) -> None:
        """Read the available results."""
        self.folder = folder
        files = {path.stem.removeprefix(PREFIX): path for path in sorted(folder.glob(f"{PREFIX}*.json"))}
        self.found: dict[str, dict[str, Any]] = {name: json.loads(p.read_text("utf-8")) for name, p in files.items()}

    def entry(self, where: Where) -> Mapping[str, Any] | None:
        """Return an entry of a result, or None where there is none."""
        found: Any = self.found
        for key in where:
            found = found.get(key) if isinstance(found, dict) else None
        return found if isinstance(found, dict) else None


def shown(entry: Mapping[str, Any] | None, number: str) -> str:
    """Return a number of an entry, with its interval where it has one."""
    if entry is not None and "why" in entry:
        return str(entry["why"])
    if entry is None or number not in entry:
        return MISSING
    value = entry[number]
    if value is None:  # not a number: most runs failed
        return "-"
    text = f"{value:.1f}" if number == "R_f" else f"{value:.2f}"
    if "interval" in entry and number in ("R_f", "fid"):
        low, high = entry["interval"]
        digits = 1 if number == "R_f" else 2
        text += f" ({low:.{digits}f} to {high:.{digits}f})"
    return text


def dated(entry: Mapping[str, Any]) -> str:
    """Return the date of an entry that is of an earlier result than the others, in brackets."""
    return f" ({entry['earlier'].split(',')[0]})" if "earlier" in entry else ""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(record.row(list(cells)) for cells in (head, ["---"] * len(head), *rows))
