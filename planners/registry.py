"""Planners by name: which there are, and how they are made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from apex_ompl.errors import ParameterError
from apex_ompl.ompl.parameters import REGISTRY, Parameters
from apex_ompl.util.forking import unforked
from apex_ompl.util.validation import check_name

if TYPE_CHECKING:
    from ompl import base as ob


def names() -> tuple[str, ...]:
    """Names of all planners."""
    _load()
    return tuple(sorted(REGISTRY))


def parameters(name: str, /, **values: Any) -> Parameters:
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


def named(params: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return parameters that a caller gives by name, or none.

    Raises:
        ParameterError: They are not values by name.
    """
    if params is None:
        return {}
    if not isinstance(params, Mapping) or not all(isinstance(name, str) for name in params):
        raise ParameterError("params", params, "values by name of parameter")
    return dict(params)


def make(name: str, si: ob.SpaceInformation, /, **values: Any) -> ob.Planner:
    """Return a planner for a space information, for example ``make("rrtconnect", si, range=0.5)``.

    Raises:
        UnknownNameError: No such planner or parameter; the message lists the known ones.
        ParameterError: A value of the wrong type or out of range.
    """
    return parameters(name, **values).build(si)


def allocator(name: str, /, **values: Any) -> Callable[[ob.SpaceInformation], ob.Planner]:
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
