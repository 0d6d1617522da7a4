"""The robot of the suites."""

from __future__ import annotations

from functools import cache

from apex_ompl.goals.state_sampling import DualArmTables
from apex_ompl.robot import Robot, load_robot

ROBOT = "dual_panda_softhand"


def robot() -> Robot:
    """Return the robot of the suites."""
    return load_robot(ROBOT)


@cache
def empty_hand_tables() -> DualArmTables:
    """Return the kernel's tables of the robot with empty hands."""
    return DualArmTables.of(robot())
