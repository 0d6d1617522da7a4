"""Compiled code over flat arrays, without Pinocchio or Coal: clearance, gradients, proofs, inverse kinematics."""

from apex_ompl.kernel.inverse_kinematics import (
    FixedVector,
    IKDescents,
    IKSolver,
    Target,
    angle_target,
    offset_target,
    opposition_target,
)
from apex_ompl.kernel.kernel import Kernel
from apex_ompl.kernel.scene_builder import Primitive, scene_tables
from apex_ompl.kernel.tables import RobotTables, SceneTables

__all__ = [
    "FixedVector",
    "IKDescents",
    "IKSolver",
    "Kernel",
    "Primitive",
    "RobotTables",
    "SceneTables",
    "Target",
    "angle_target",
    "offset_target",
    "opposition_target",
    "scene_tables",
]
