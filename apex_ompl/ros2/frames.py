"""Frames of headers: where each is in the robot's world."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.robot.model import Robot
from apex_ompl.ros2.messages import transform_matrix
from apex_ompl.types import Array

DEEPEST = 100  # transforms between a frame and the world


class Frames:
    """Poses of frames in the world, by parameters, links of the robot, and the newest messages on ``/tf``.

    A frame is looked up in this order; a transform of ``/tf`` leads to its parent.
    """

    def __init__(self, robot: Robot, world: str, given: Mapping[str, Array]) -> None:
        """Know the world, the robot, and frames whose poses in the world are given, shape (4, 4) [m]."""
        self._robot, self._world, self._given = robot, world.lstrip("/"), dict(given)
        self._parents: dict[str, tuple[str, Array]] = {}

    def take(self, transforms: Iterable[Any]) -> None:
        """Take ``geometry_msgs/TransformStamped``; those with a number that is not finite are left out."""
        for one in transforms:
            try:
                pose = transform_matrix(one.transform)
            except ParameterError:
                continue
            self._parents[one.child_frame_id.lstrip("/")] = one.header.frame_id.lstrip("/"), pose

    def pose(self, frame: str, q: Array) -> Array:
        """Return the pose of a frame in the world where the robot is in a state, shape (4, 4) [m].

        Args:
            frame: Its name; without one it is the world.
            q: The state, shape (dof,).

        Raises:
            ParameterError: The frame is unknown.
        """
        name, found = frame.lstrip("/"), np.eye(4)
        for _ in range(DEEPEST):
            if name in ("", self._world):
                return found
            if name in self._given:
                return self._given[name] @ found
            if name in self._robot.link_names:
                return self._robot.link_pose(q, name) @ found
            if name not in self._parents:
                break
            name, pose = self._parents[name]
            found = pose @ found
        expected = f"{self._world}, a link of {self._robot.name}, a frame of the parameter frames, or one on /tf"
        raise ParameterError("frame_id", frame if name == frame.lstrip("/") else f"{frame} below {name}", expected)
