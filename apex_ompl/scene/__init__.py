"""Planning problems and their files: bodies, meshes, points, start and goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.scene.bodies import AttachedObject as AttachedObject
    from apex_ompl.scene.bodies import ContactFace as ContactFace
    from apex_ompl.scene.bodies import HandGrasp as HandGrasp
    from apex_ompl.scene.bodies import Obstacle as Obstacle
    from apex_ompl.scene.constraints import FixedOrientation as FixedOrientation
    from apex_ompl.scene.constraints import OnLine as OnLine
    from apex_ompl.scene.constraints import OnPlane as OnPlane
    from apex_ompl.scene.constraints import Pose as Pose
    from apex_ompl.scene.constraints import PoseTolerance as PoseTolerance
    from apex_ompl.scene.constraints import RelativePose as RelativePose
    from apex_ompl.scene.constraints import ToolRegion as ToolRegion
    from apex_ompl.scene.constraints import Upright as Upright
    from apex_ompl.scene.points import points_from_depth as points_from_depth
    from apex_ompl.scene.problem import Alignment as Alignment
    from apex_ompl.scene.problem import Goal as Goal
    from apex_ompl.scene.problem import GraspGoal as GraspGoal
    from apex_ompl.scene.problem import MoveStep as MoveStep
    from apex_ompl.scene.problem import PoseTarget as PoseTarget
    from apex_ompl.scene.problem import Problem as Problem
    from apex_ompl.scene.problem import Tolerance as Tolerance
    from apex_ompl.scene.steps import AddStep as AddStep
    from apex_ompl.scene.steps import AllowStep as AllowStep
    from apex_ompl.scene.steps import AttachStep as AttachStep
    from apex_ompl.scene.steps import DetachStep as DetachStep
    from apex_ompl.scene.steps import GraspStep as GraspStep
    from apex_ompl.scene.steps import HandStep as HandStep
    from apex_ompl.scene.steps import LineStep as LineStep
    from apex_ompl.scene.steps import ReleaseStep as ReleaseStep
    from apex_ompl.scene.steps import RemoveStep as RemoveStep
    from apex_ompl.scene.steps import RetreatStep as RetreatStep
    from apex_ompl.scene.steps import TogetherStep as TogetherStep
    from apex_ompl.scene.steps import TurnStep as TurnStep
    from apex_ompl.scene.steps import WaitStep as WaitStep

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "bodies": "AttachedObject ContactFace HandGrasp Obstacle",
        "constraints": "FixedOrientation OnLine OnPlane Pose PoseTolerance RelativePose ToolRegion Upright",
        "points": "points_from_depth",
        "problem": "Alignment Goal GraspGoal MoveStep PoseTarget Problem Tolerance",
        "steps": "AddStep AllowStep AttachStep DetachStep GraspStep HandStep LineStep ReleaseStep RemoveStep "
        "RetreatStep TogetherStep TurnStep WaitStep",
    },
)
