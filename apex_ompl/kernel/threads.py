"""Work on rows of arrays by several threads: compiled code needs no lock of the interpreter."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from apex_ompl.util.validation import check_integer

PART = 256  # rows, fewer than which are not worth a thread of their own


def in_threads(count: int, threads: int, call: Callable[[slice], None]) -> None:
    """Call with slices that together are all of some rows, several at once in threads.

    Raises:
        ParameterError: The number of threads is no positive whole number.
    """
    parts = min(check_integer(threads, "threads", 1), max(count // PART, 1))
    if parts == 1:
        call(slice(count))
        return
    edges = np.linspace(0, count, parts + 1).astype(int).tolist()
    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(call, (slice(first, end) for first, end in pairwise(edges))))
