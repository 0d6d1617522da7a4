"""One thread for small networks: with more, and a busy core, an evaluation takes many times longer."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_lock = threading.Lock()
_before: list[int] = []  # thread counts to go back to, one for each block at work


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute on one thread inside of the block, and on as many as before behind it.

    Blocks may overlap in several threads; the last to end goes back.
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
