"""The client library of ROS 2 and the messages of the node, which are optional."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from apex_ompl.util.extras import names_of

NEEDED = {
    "rclpy": ("Context", "Parameter", "create_node", "init"), "rclpy.executors": ("SingleThreadedExecutor",),
    "rclpy.qos": ("DurabilityPolicy", "QoSProfile", "qos_profile_sensor_data"), "rclpy.time": ("Time",),
    "rclpy.task": ("Future",), "builtin_interfaces.msg": ("Duration",),
    "diagnostic_msgs.msg": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
    "geometry_msgs.msg": ("Point", "PoseArray", "PoseStamped"),
    "rcl_interfaces.msg": ("FloatingPointRange", "IntegerRange", "ParameterDescriptor", "SetParametersResult"),
    "sensor_msgs.msg": ("JointState", "PointCloud2"), "std_msgs.msg": ("ColorRGBA", "String"),
    "trajectory_msgs.msg": ("JointTrajectory", "JointTrajectoryPoint"),
    "visualization_msgs.msg": ("Marker", "MarkerArray"),
}  # fmt: skip
OPTIONAL = {"tf2_msgs.msg": ("TFMessage",), "moveit_msgs.srv": ("GetMotionPlan",)}
"""Packages without wheels: a ROS 2 of the system has them."""


def ros2() -> Any:
    """Return what the node uses of ``rclpy`` and of messages, as one namespace; None for optional ones that lack.

    Raises:
        MissingFileError: The extra ``ros2`` is not installed, nor a ROS 2 of the system sourced.
    """
    found = names_of(NEEDED, "rclpy", "ROS 2", "ros2")
    for module, names in OPTIONAL.items():
        try:
            vars(found).update({name: getattr(import_module(module), name) for name in names})
        except ImportError:
            vars(found).update(dict.fromkeys(names))
    return found
