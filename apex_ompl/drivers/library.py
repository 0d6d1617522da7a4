"""The optional libraries: MuJoCo, the client library of ROS 2, rosbags, and those of Franka's arms."""

from __future__ import annotations

import os
from collections.abc import Mapping
from ctypes.util import find_library
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from apex_ompl.errors import MissingFileError
from apex_ompl.util.forking import unforked


def mujoco() -> Any:
    """Return the module ``mujoco``, set up to draw by EGL or OSMesa on a machine without a display.

    Raises:
        MissingFileError: The extra ``twin`` is not installed.
    """
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "osmesa")  # which is read at the import
    try:
        with unforked():
            return import_module("mujoco")
    except ImportError as error:
        raise MissingFileError("mujoco", "package for physics", "install the extra: apex-ompl[twin]") from error


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
    try:
        with unforked():
            bags, types = import_module("rosbags.rosbag2"), import_module("rosbags.typesys")
    except ImportError as error:
        raise MissingFileError("rosbags", "package for bags of ROS 2", "install the extra: apex-ompl[bags]") from error
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


def names_of(places: Mapping[str, tuple[str, ...]], package: str, purpose: str, extra: str) -> Any:
    """Return names of an optional package as one namespace.

    Args:
        places: The names by the modules that have them.
        package: Name of the package.
        purpose: What it is for.
        extra: The extra that installs it.

    Raises:
        MissingFileError: It is not installed.
    """
    try:
        with unforked():
            found = {name: getattr(import_module(module), name) for module, names in places.items() for name in names}
    except ImportError as error:
        raise MissingFileError(package, f"package for {purpose}", f"install the extra: apex-ompl[{extra}]") from error
    return SimpleNamespace(**found)
