"""Decorators of the kernel's functions: they come from the library that is built ahead of time, or numba compiles them.

numba is not imported before it is to compile: a function that only other compiled ones call is handed to it when one
of these is compiled. See :mod:`apex_ompl.kernel.library` and :mod:`apex_ompl.kernel.compiled.jit`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, update_wrapper
from typing import Any, TypeVar, cast

from apex_ompl.kernel.library import built_function

F = TypeVar("F", bound=Callable[..., Any])


class Deferred:
    """A function of numba's that is made when numba asks for it."""

    def __init__(self, make: Callable[[], Any]) -> None:
        """Defer ``make``, which returns numba's function."""
        self._make = make

    @cached_property
    def made(self) -> Any:
        """The function as numba knows it."""
        return self._make()

    @property
    def _numba_type_(self) -> Any:
        """Its type, which numba asks for wherever a compiled function names it."""
        from apex_ompl.kernel.compiled import jit

        return jit.type_of(self.made)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of numba's function."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.made, name)

    def __call__(self, *_: Any) -> Any:
        """Refuse a call from Python, where views of arrays would not be counted."""
        raise TypeError(f"{getattr(self, '__name__', 'this function')} is called by compiled functions only")


def inlined(function: F) -> F:
    """Mark a function that only other compiled ones call; LLVM inlines it."""
    return _inner(function, forceinline=True)


def reassociating_inlined(function: F) -> F:
    """Mark a function as :func:`inlined` does, in which sums may be taken in any order, several at a time."""
    return _inner(function, forceinline=True, reassociating=True)


def outlined(function: F) -> F:
    """Mark a function that only other compiled ones call, compiled once for all; LLVM inlines it where it is short."""
    return _inner(function, forceinline=False)


def ir_inlined(function: F) -> F:
    """Mark a function that only other compiled ones call; numba inlines it, which functions that return arrays need.

    Without numba's runtime no array can be returned from a function that is left standing.
    """
    return _inner(function, inline="always")


def entry_point(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that Python calls, as compiled code.

    Calls release the global interpreter lock, and run on the calling thread alone.
    """
    return built_function(function) or _jit_entry_point(function)


def reassociating_entry_point(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function as :func:`entry_point` does, in which sums may be taken in any order, several at a time."""
    return built_function(function) or _jit_entry_point(function, reassociating=True)


def _inner(function: F, **options: Any) -> F:
    def make() -> Any:
        from apex_ompl.kernel.compiled import jit

        return jit.inner(function, **options)

    return cast(F, update_wrapper(Deferred(make), function))


def _jit_entry_point(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    from apex_ompl.kernel.compiled import jit

    return jit.CompiledFunction(function, **options)
