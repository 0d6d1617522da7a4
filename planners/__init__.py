"""Planners by name: OMPL's own and this package's, each with a frozen record of its parameters."""

if not __name__.startswith("apex_ompl."):  # the folder also lies at the top of the source tree
    raise ImportError("import apex_ompl.planners, not planners")

from typing import Any

from apex_ompl.planners.registry import Parameters, allocator, make, named, names, parameters
from apex_ompl.planners.tuned import TUNED
from apex_ompl.util.forking import unforked

__all__ = ["APEX", "TUNED", "Parameters", "allocator", "make", "named", "names", "parameters"]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    if name == "APEX":  # torch comes with it
        with unforked():
            from apex_ompl.planners.apex import APEX

        return APEX
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
