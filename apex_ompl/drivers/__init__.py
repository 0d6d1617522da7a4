"""Drivers: robots that follow motions, in physics or real."""

from __future__ import annotations

from typing import TYPE_CHECKING

from apex_ompl.util.lazy import lazy_names

if TYPE_CHECKING:
    from apex_ompl.drivers.bag import BagDriver as BagDriver
    from apex_ompl.drivers.combined import CombinedDriver as CombinedDriver
    from apex_ompl.drivers.driver import Driver as Driver
    from apex_ompl.drivers.driver import DriverState as DriverState
    from apex_ompl.drivers.franka import FrankaDriver as FrankaDriver
    from apex_ompl.drivers.franka_arms import FrankaSettings as FrankaSettings
    from apex_ompl.drivers.function import FunctionDriver as FunctionDriver
    from apex_ompl.drivers.guard import Guard as Guard
    from apex_ompl.drivers.kinematic import KinematicDriver as KinematicDriver
    from apex_ompl.drivers.mujoco import MujocoDriver as MujocoDriver
    from apex_ompl.drivers.ros2 import Ros2Driver as Ros2Driver
    from apex_ompl.drivers.twin import Twin as Twin
    from apex_ompl.drivers.twin_settings import TwinSettings as TwinSettings

__all__, __getattr__, __dir__ = lazy_names(
    __name__,
    {
        "bag": "BagDriver",
        "combined": "CombinedDriver",
        "driver": "Driver DriverState",
        "franka": "FrankaDriver",
        "franka_arms": "FrankaSettings",
        "function": "FunctionDriver",
        "guard": "Guard",
        "kinematic": "KinematicDriver",
        "mujoco": "MujocoDriver",
        "ros2": "Ros2Driver",
        "twin": "Twin",
        "twin_settings": "TwinSettings",
    },  # fmt: skip
)
