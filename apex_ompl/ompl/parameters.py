"""Parameters of planners as frozen records, which planners register under their names."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar

from apex_ompl.errors import ParameterError
from apex_ompl.util.validation import LARGEST_INT, check_name

if TYPE_CHECKING:
    from ompl import base as ob


Value = bool | float | str
"""Value of a parameter; text is read as the type of the parameter."""


@dataclass(frozen=True)
class Parameters:
    """Parameters of one planner; a subclass per planner, whose defaults are the planner's.

    Attributes:
        name: Name that the planner is registered under; empty for one that is not.
        optimizing: Whether the planner goes on improving until time is up.
        repeatable: Whether the same seed gives the same path; not for planners that are stopped by the clock
            or threaded.
        smooth: Whether its paths are short and smooth already, and shortcuts would only break them.
        threaded: Whether the planner runs threads of its own; OMPL 2.0.1's then deadlock over several goals.
        constrained: Whether it plans under constraints along the path.
    """

    name: ClassVar[str] = ""
    optimizing: ClassVar[bool] = False
    repeatable: ClassVar[bool] = True
    smooth: ClassVar[bool] = False
    threaded: ClassVar[bool] = False
    constrained: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ParameterError: One is of the wrong type or out of range.
        """
        for field in fields(self):
            _read(field.name, getattr(self, field.name), field.default, field)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return a planner for ``si`` with these parameters."""
        raise TypeError(f"{type(self).__name__} does not say how to build its planner")

    def changed(self, /, **values: Value) -> Self:
        """Return a copy with some values changed; text is read as the field's type.

        Raises:
            UnknownNameError: No parameter of that name.
            ParameterError: A value of the wrong type or out of range.
        """
        known = {f.name: f for f in fields(self)}
        for name in values:
            check_name(name, "parameter", known)
        read = {name: _read(name, value, getattr(self, name), known[name]) for name, value in values.items()}
        return dataclasses.replace(self, **read)


def bounded(default: Any, low: float, high: float = float("inf"), unit: str = "") -> Any:
    """Return a dataclass field with a range, ends included; the unit is for documentation."""
    return dataclasses.field(default=default, metadata={"low": low, "high": high, "unit": unit})


def one_of(default: str, *others: str) -> Any:
    """Return a dataclass field that is one of some words."""
    return dataclasses.field(default=default, metadata={"words": (default, *others)})


ParametersT = TypeVar("ParametersT", bound=Parameters)

REGISTRY: dict[str, type[Parameters]] = {}
"""Parameters by name of planner, of those whose modules were imported; see :mod:`apex_ompl.planners`."""


def register(name: str) -> Callable[[type[ParametersT]], type[ParametersT]]:
    """Register a parameter class under a planner name."""

    def enter(cls: type[ParametersT]) -> type[ParametersT]:
        REGISTRY[name] = cls
        cls.name = name
        return cls

    return enter


def _read(name: str, value: Any, default: Any, field: dataclasses.Field[Any]) -> Any:
    """Return ``value`` as the type of ``default``, in range."""
    kind = type(default)
    if kind is str:
        words = field.metadata.get("words", ())
        if not isinstance(value, str) or not value or (words and value not in words):
            raise ParameterError(f"parameter {name!r}", value, f"one of {', '.join(words)}" if words else "a name")
        return value
    expected = {bool: "true or false", int: "a whole number", float: "a number"}[kind]
    low, high = field.metadata.get("low", -float("inf")), field.metadata.get("high", float("inf"))
    high = min(high, LARGEST_INT) if kind is int else high
    if low > -float("inf") or high < float("inf"):
        expected += f" in [{low:g}, {high:g}]"
    read = value
    if isinstance(value, str):
        word = value.strip().lower()
        words = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
        try:
            read = words.get(word) if kind is bool else kind(word)
        except ValueError:
            read = None
    elif kind is float and type(value) is int and abs(value) < sys.float_info.max:
        read = float(value)
    if type(read) is not kind or not low <= read <= high:
        raise ParameterError(f"parameter {name!r}", value, expected)
    return read
