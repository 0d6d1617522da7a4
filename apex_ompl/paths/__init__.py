"""Trajectory optimization: B-spline paths, the optimizer with cost terms of the user, the candidate pool."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.paths.candidates import first_valid
    from apex_ompl.paths.cost_terms import CostTerm
    from apex_ompl.paths.optimizer import OptimizationResult, Optimizer, OptimizerSettings
    from apex_ompl.paths.path import Path, path_length
    from apex_ompl.paths.spline import Spline

__all__ = [
    "CostTerm",
    "OptimizationResult",
    "Optimizer",
    "OptimizerSettings",
    "Path",
    "Spline",
    "first_valid",
    "path_length",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "CostTerm": "cost_terms",
        "OptimizationResult": "optimizer",
        "Optimizer": "optimizer",
        "OptimizerSettings": "optimizer",
        "Path": "path",
        "Spline": "spline",
        "first_valid": "candidates",
        "path_length": "path",
    },
)
