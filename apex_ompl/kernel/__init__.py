"""The compiled kernel over flat arrays, without Pinocchio or Coal: clearance, gradients, proofs, inverse kinematics."""

from apex_ompl.kernel.interface import Kernel
from apex_ompl.kernel.inverse_kinematics import Fixed, Inverse, Target, facing, gap, slope
from apex_ompl.kernel.scene_builder import Primitive, scene_tables
from apex_ompl.kernel.tables import RobotTables, SceneTables

__all__ = [
    "Fixed",
    "Inverse",
    "Kernel",
    "Primitive",
    "RobotTables",
    "SceneTables",
    "Target",
    "facing",
    "gap",
    "scene_tables",
    "slope",
]
