"""Results that are kept for as long as the object that they were computed from."""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, Generic, TypeVar
from weakref import ref

R = TypeVar("R")


class weakly_cached(Generic[R]):  # noqa: N801 - a decorator
    """Keep the results of a function of one object, which must not change, until the object is deleted.

    Objects are told apart by identity: those of Coal compare their whole content.
    """

    def __init__(self, function: Callable[[Any], R]) -> None:
        """Wrap a function."""
        self._function = function
        self._kept: dict[int, tuple[ref[Any], R]] = {}
        update_wrapper(self, function)

    def __call__(self, item: Any) -> R:
        """Return the result of the function, or the one that is kept."""
        found = self._kept.get(id(item))
        if found is not None and found[0]() is item:
            return found[1]
        result = self._function(item)
        self.keep(item, result)
        return result

    def keep(self, item: Any, result: R) -> None:
        """Keep a result that is known already."""
        number = id(item)
        self._kept[number] = ref(item, lambda _: self._kept.pop(number, None)), result
