"""APEX: the planner's parameters, the stages of ``solve``, what they share, and queries of the trajectory model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.apex.context import SolveContext
    from apex_ompl.apex.models import make_query
    from apex_ompl.apex.parameters import ApexParameters
    from apex_ompl.apex.stages.stage import Stage

__all__ = ["ApexParameters", "SolveContext", "Stage", "make_query"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {"ApexParameters": "parameters", "SolveContext": "context", "Stage": "stages.stage", "make_query": "models"},
)
