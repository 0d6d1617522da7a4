"""A progress bar for work that is mostly short."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")


def progress(items: Sequence[T], what: str, after: float) -> Iterator[T]:
    """Yield items, and show on a terminal how many are done when they take long.

    Args:
        items: The items.
        what: Their name.
        after: How long they may take until the bar is shown [s].
    """
    bar, started = None, time.monotonic()
    try:
        for done, item in enumerate(items):
            if bar is None and time.monotonic() - started > after:
                from tqdm import tqdm  # takes longer to import than most items

                bar = tqdm(total=len(items), initial=done, desc=what, leave=False, disable=None)
            yield item
            if bar is not None:
                bar.update()
    finally:
        if bar is not None:
            bar.close()
