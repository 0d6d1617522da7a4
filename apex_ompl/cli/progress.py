"""Progress of long commands on a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn, Protocol


class Report(Protocol):
    """What a long command calls: the stage, the share of it that is done, and a text beside it."""

    def __call__(self, stage: str, share: float, text: str = "") -> None:
        """Show how far a stage is."""


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Show a bar for each stage while a block runs; nothing where the error output is no terminal."""
    from tqdm import tqdm

    bars: dict[str, tqdm[NoReturn]] = {}
    shown = "{desc}: {percentage:3.0f}% |{bar}| {elapsed}{postfix}"

    def report(stage: str, share: float, text: str = "") -> None:
        if stage not in bars:
            bars[stage] = tqdm(total=1.0, desc=stage, disable=None, bar_format=shown)
        if text:
            bars[stage].set_postfix_str(text, refresh=False)
        bars[stage].update(share - bars[stage].n)

    try:
        yield report
    finally:
        for bar in bars.values():
            bar.close()
