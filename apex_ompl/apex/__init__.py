"""APEX: the planner's parameters, the stages of ``solve``, what they share, and queries of the trajectory model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.apex.context import SolveContext as SolveContext
    from apex_ompl.apex.models import make_query as make_query
    from apex_ompl.apex.parameters import ApexParameters as ApexParameters
    from apex_ompl.apex.stages.stage import Stage as Stage

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {"context": "SolveContext", "models": "make_query", "parameters": "ApexParameters", "stages.stage": "Stage"},
)
