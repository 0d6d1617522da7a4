"""Planning problems and their files: bodies, meshes, points, start and goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.scene.bodies import AttachedObject as AttachedObject
    from apex_ompl.scene.bodies import Obstacle as Obstacle
    from apex_ompl.scene.points import points_from_depth as points_from_depth
    from apex_ompl.scene.problem import Alignment as Alignment
    from apex_ompl.scene.problem import Goal as Goal
    from apex_ompl.scene.problem import PoseTarget as PoseTarget
    from apex_ompl.scene.problem import PoseTolerance as PoseTolerance
    from apex_ompl.scene.problem import Problem as Problem
    from apex_ompl.scene.problem import Tolerance as Tolerance

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "bodies": "AttachedObject Obstacle",
        "points": "points_from_depth",
        "problem": "Alignment Goal PoseTarget PoseTolerance Problem Tolerance",
    },
)
