"""Robots: loading, composition, limits and links."""

from apex_ompl.robot.model import Limits, Robot, load_robot, robot_names

__all__ = ["Limits", "Robot", "load_robot", "robot_names"]
