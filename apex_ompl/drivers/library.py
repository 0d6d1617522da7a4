"""The optional libraries: MuJoCo, the client library of ROS 2, rosbags, and those of Franka's arms."""

from __future__ import annotations

import os
from ctypes.util import find_library
from types import SimpleNamespace
from typing import Any

from apex_ompl.util.extras import import_extra, names_of


def mujoco() -> Any:
    """Return the module ``mujoco``, set up to draw by EGL or OSMesa on a machine without a display.

    Raises:
        MissingFileError: The extra ``twin`` is not installed.
    """
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "osmesa")  # which is read at the import
    return import_extra("mujoco", "physics", "twin")


def rclpy() -> Any:
    """Return what drivers use of ``rclpy`` and of messages, as one namespace.

    Raises:
        MissingFileError: The extra ``ros2`` is not installed, nor a ROS 2 of the system sourced.
    """
    places = {
        "rclpy": ("Context", "init", "create_node"), "rclpy.executors": ("SingleThreadedExecutor",),
        "rclpy.qos": ("qos_profile_sensor_data",), "rclpy.time": ("Time",), "sensor_msgs.msg": ("JointState",),
        "trajectory_msgs.msg": ("JointTrajectory", "JointTrajectoryPoint"),
    }  # fmt: skip
    return names_of(places, "rclpy", "ROS 2", "ros2")


def rosbags() -> Any:
    """Return what drivers use of ``rosbags``, as one namespace.

    Raises:
        MissingFileError: The extra ``bags`` is not installed.
    """
    bags, types = (import_extra(f"rosbags.{one}", "bags of ROS 2", "bags") for one in ("rosbag2", "typesys"))
    return SimpleNamespace(
        Writer=bags.Writer, plugin=bags.StoragePlugin, types=types.get_typestore(types.Stores.ROS2_JAZZY)
    )


def panda_py() -> Any:
    """Return what drivers use of ``panda_py``, as one namespace.

    Raises:
        MissingFileError: The package ``panda-python`` is not installed.
    """
    places = {
        "panda_py": ("Panda",), "panda_py.controllers": ("JointPosition",), "panda_py.libfranka": ("RealtimeConfig",),
    }  # fmt: skip
    return names_of(places, "panda_py", "Franka's arms", "panda")


def franky() -> Any:
    """Return what drivers use of ``franky``, as one namespace.

    Raises:
        MissingFileError: The package ``franky-control`` is not installed.
    """
    places = {"franky": ("JointImpedanceTracker", "RealtimeConfig", "Robot")}
    return names_of(places, "franky", "Franka's arms", "fr3")
