"""Planning problems and their files: bodies, meshes, points, start and goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.scene.bodies import AttachedObject, Obstacle
    from apex_ompl.scene.points import points_from_depth
    from apex_ompl.scene.problem import Alignment, Goal, PoseTarget, PoseTolerance, Problem, Tolerance

__all__ = [
    "Alignment",
    "AttachedObject",
    "Goal",
    "Obstacle",
    "PoseTarget",
    "PoseTolerance",
    "Problem",
    "Tolerance",
    "points_from_depth",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "Alignment": "problem",
        "AttachedObject": "bodies",
        "Goal": "problem",
        "Obstacle": "bodies",
        "PoseTarget": "problem",
        "PoseTolerance": "problem",
        "Problem": "problem",
        "Tolerance": "problem",
        "points_from_depth": "points",
    },
)
