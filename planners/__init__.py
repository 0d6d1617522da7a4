"""Planners by name: OMPL's own and this package's, each with a frozen record of its parameters.

Where each lies:

- ``apex``: :mod:`apex_ompl.apex.planner`, with its stages in :mod:`apex_ompl.apex.stages`;
- ``rrtconnect+polish``: :mod:`apex_ompl.planners.polish`;
- OMPL's own, such as ``rrtconnect`` and ``bitstar``: :mod:`apex_ompl.planners.sampling`;
- the rivals of the paper: ``gpmp`` and ``gpmp2`` in :mod:`apex_ompl.baselines.gpmp`, ``drrt`` in
  :mod:`apex_ompl.baselines.drrt`, ``damon`` in :mod:`apex_ompl.baselines.damon`, ``il`` and ``il-paper`` in
  :mod:`apex_ompl.baselines.imitation`.

:mod:`apex_ompl.planners.registry` finds them by name; each registers itself when its module is imported.
"""

from typing import Any

from apex_ompl.ompl.parameters import Parameters
from apex_ompl.ompl.tuned import TUNED
from apex_ompl.planners.registry import AnyPlanner, allocator, chosen, make, names, parameters
from apex_ompl.util.forking import unforked

__all__ = ["APEX", "TUNED", "AnyPlanner", "Parameters", "allocator", "chosen", "make", "names", "parameters"]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    if name == "APEX":  # torch comes with it
        with unforked():
            from apex_ompl.apex.planner import APEX

        return APEX
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
