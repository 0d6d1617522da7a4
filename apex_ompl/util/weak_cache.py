"""Results that are kept for as long as the object that they were computed from."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar
from weakref import ref

R = TypeVar("R")


def weakly_cached(function: Callable[[Any], R]) -> Callable[[Any], R]:
    """Keep the results of a function of one object, which must not change, until the object is deleted.

    Objects are told apart by identity: those of Coal compare their whole content. A result that is known already is
    kept by the function's ``keep(item, result)``.
    """
    kept: dict[int, tuple[ref[Any], R]] = {}

    @wraps(function)
    def cached(item: Any) -> R:
        number = id(item)
        found = kept.get(number)
        if found is not None and found[0]() is item:
            return found[1]
        result = function(item)
        keep(item, result)
        return result

    def keep(item: Any, result: R) -> None:
        number = id(item)
        kept[number] = ref(item, lambda _: kept.pop(number, None)), result

    cached.keep = keep  # type: ignore[attr-defined]
    return cached
