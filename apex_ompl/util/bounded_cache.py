"""Results that are kept by key, up to a number of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

R = TypeVar("R")


def kept(results: dict[str, R], key: str, make: Callable[[], R], most: int) -> R:
    """Return the result of a key, made where there is none; beyond ``most`` results the oldest are dropped."""
    if (known := results.get(key)) is not None:  # another thread may drop it
        return known
    result = make()
    while len(results) >= most:
        results.pop(next(iter(results)), None)
    results[key] = result
    return result
