"""The compiled kernel: clearance, its gradient and proofs of freedom over flat arrays, without Pinocchio or Coal."""

from apex_ompl.kernel.face import Kernel
from apex_ompl.kernel.scene import Primitive, scene_tables
from apex_ompl.kernel.tables import RobotTables, SceneTables

__all__ = ["Kernel", "Primitive", "RobotTables", "SceneTables", "scene_tables"]
