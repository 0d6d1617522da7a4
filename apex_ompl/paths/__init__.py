"""Trajectory optimization: B-spline paths, the optimizer with cost terms of the user, the candidate pool."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.paths.candidates import first_valid as first_valid
    from apex_ompl.paths.cost_terms import CostTerm as CostTerm
    from apex_ompl.paths.optimizer import OptimizationResult as OptimizationResult
    from apex_ompl.paths.optimizer import Optimizer as Optimizer
    from apex_ompl.paths.optimizer import OptimizerSettings as OptimizerSettings
    from apex_ompl.paths.path import Path as Path
    from apex_ompl.paths.path import path_length as path_length
    from apex_ompl.paths.spline import Spline as Spline

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "candidates": "first_valid",
        "cost_terms": "CostTerm",
        "optimizer": "OptimizationResult Optimizer OptimizerSettings",
        "path": "Path path_length",
        "spline": "Spline",
    },
)
