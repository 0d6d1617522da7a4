"""Planners by name: which there are, and how they are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from apex_ompl.errors import ParameterError
from apex_ompl.ompl.parameters import REGISTRY, Parameters, Value
from apex_ompl.util.forking import unforked
from apex_ompl.util.validation import check_name

if TYPE_CHECKING:
    from ompl import base as ob


AnyPlanner = str | Parameters | Callable[["ob.SpaceInformation"], "ob.Planner"]
"""A planner: its name, its parameters, or a function that makes it, as for OMPL's ``setPlannerAllocator``."""


class MadeByFunction(Parameters):
    """A planner that a user's function makes."""

    constrained: ClassVar[bool] = True

    def __init__(self, make: Callable[[ob.SpaceInformation], ob.Planner]) -> None:
        """Make the planner by a function of OMPL's space information."""
        object.__setattr__(self, "_make", make)

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner."""
        made: ob.Planner = self._make(si)  # type: ignore[attr-defined]
        return made


def names() -> tuple[str, ...]:
    """Names of all planners."""
    _load()
    return tuple(sorted(REGISTRY))


def parameters(name: str, /, **values: Value) -> Parameters:
    """Return the parameters of a planner: its defaults, with some values changed.

    Raises:
        UnknownNameError: No such planner or parameter; the message lists the known ones.
        ParameterError: A value of the wrong type or out of range.
    """
    with unforked():
        from apex_ompl.apex import parameters as apex
    if name != apex.NAME:  # it is the default; the modules of the others take longer to import
        _load()
    return REGISTRY[check_name(name, "planner", REGISTRY)]().changed(**values)


def _named(params: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return parameters that a caller gives by name, or none.

    Raises:
        ParameterError: They are not values by name.
    """
    if params is None:
        return {}
    if not isinstance(params, Mapping) or not all(isinstance(name, str) for name in params):
        raise ParameterError("params", params, "values by name of parameter")
    return dict(params)


def chosen(planner: AnyPlanner, params: Mapping[str, Any] | None = None, **defaults: Value | None) -> Parameters:
    """Return the parameters of a planner.

    Args:
        planner: Name of a planner, its parameters, or a function that makes it.
        params: Parameters in place of its own, by name.
        **defaults: Of a planner that is given by name, parameters that it may have and that ``params`` has not; None
            for the planner's own.

    Raises:
        UnknownNameError: No such planner or parameter; the message lists the known ones.
        ParameterError: A value of the wrong type or out of range.
    """
    given = _named(params)
    if isinstance(planner, str):
        known = parameters(planner)
        wanted = {name: value for name, value in defaults.items() if value is not None and hasattr(known, name)}
        return known.changed(**(wanted | given))
    if not isinstance(planner, Parameters):
        if not callable(planner):
            return parameters(planner)  # type: ignore[unreachable] # which names the planners that there are
        made_of = getattr(planner, "__self__", None)  # of ``allocator``, whose functions are methods of parameters
        planner = made_of if isinstance(made_of, Parameters) else MadeByFunction(planner)
    return planner.changed(**given) if given else planner


def make(name: str, si: ob.SpaceInformation, /, **values: Value) -> ob.Planner:
    """Return a planner for a space information, for example ``make("rrtconnect", si, range=0.5)``.

    Raises:
        UnknownNameError: No such planner or parameter; the message lists the known ones.
        ParameterError: A value of the wrong type or out of range.
    """
    return parameters(name, **values).build(si)


def allocator(name: str, /, **values: Value) -> Callable[[ob.SpaceInformation], ob.Planner]:
    """Return an allocator for ``SimpleSetup.setPlannerAllocator``.

    Raises:
        UnknownNameError: No such planner or parameter; the message lists the known ones.
        ParameterError: A value of the wrong type or out of range.
    """
    return parameters(name, **values).build


def _load() -> None:
    """Import the modules that register planners."""
    with unforked():
        import apex_ompl.baselines.damon.planner
        import apex_ompl.baselines.drrt.planner
        import apex_ompl.baselines.gpmp.planner
        import apex_ompl.baselines.imitation.planner
        import apex_ompl.planners.polish
        import apex_ompl.planners.sampling  # noqa: F401
