"""Thread count of torch: small networks are evaluated by one thread, as several wait for each other on busy cores."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from apex_ompl.util.forking import ProcessLock

_lock = ProcessLock()
_before: list[int] = []  # thread count to restore, one entry for each active block


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute by one thread inside the block, and restore the thread count afterwards.

    Blocks may overlap in several threads; the last one to end restores the count.
    """
    with _lock:
        _before.append(_before[0] if _before else torch.get_num_threads())
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _lock:
            count = _before.pop()
            if not _before:
                torch.set_num_threads(count)
