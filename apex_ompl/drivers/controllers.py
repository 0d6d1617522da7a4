"""Controllers of ROS 2 by name, the joints that each moves, and what a motion is for each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.timing.files import NANOSECONDS, check_controllers
from apex_ompl.timing.knots import on_grid, spaced
from apex_ompl.timing.trajectory import Trajectory

CLOSEST = 1e-6  # knots that are nearer to each other are moved apart: their polynomials would be rounding alone [s]

Point = tuple[int, list[float], list[float], list[float]]
"""Time from the start [ns], positions, velocities and accelerations."""


class ControllerMotion(NamedTuple):
    """What a controller gets of a motion.

    Attributes:
        controller: Its name.
        topic: Where it listens.
        joints: Names of its joints in ROS.
        points: The states between which polynomials of fifth degree are the motion.
    """

    controller: str
    topic: str
    joints: list[str]
    points: list[Point]


class Controllers:
    """The controllers of a robot.

    Attributes:
        joints: Names of the joints that each moves, by its name.
        ros_names: Names of all joints in ROS, in the robot's order.
    """

    def __init__(
        self, names: Sequence[str], controllers: Mapping[str, Sequence[str]] | str, renamed: Mapping[str, str] | None
    ) -> None:
        """Check that each joint has one controller.

        Args:
            names: Names of the robot's joints.
            controllers: The joints that each controller moves, by its name, together all; or the name of the one that
                moves them all.
            renamed: Names of joints in ROS where they are others, by ours.

        Raises:
            ParameterError: A joint has no controller, or more than one, or is unknown.
        """
        given = {controllers: names} if isinstance(controllers, str) else controllers
        check_controllers(given, names)
        self.joints = {name: tuple(joints) for name, joints in given.items()}
        other = dict(renamed or {})
        unknown = sorted({*other} - {*names})
        if unknown:
            raise ParameterError("renamed", unknown[0], f"joints of the robot: {', '.join(names)}")
        self._names = tuple(names)
        self.ros_names = [other.get(name, name) for name in names]

    @property
    def topics(self) -> list[str]:
        """Where they listen."""
        return [f"/{name}/joint_trajectory" for name in self.joints]

    def parts(self, motion: Trajectory) -> Iterator[ControllerMotion]:
        """Yield what each controller gets of a motion, at knots on whole nanoseconds, at least ``CLOSEST`` apart."""
        near = np.diff(motion.times).min(initial=CLOSEST) < CLOSEST
        times = spaced(motion.times, CLOSEST) if near else on_grid(motion.times)
        ticks, states = np.rint(times * NANOSECONDS).astype(np.int64), motion.states(np.minimum(times, motion.duration))
        for topic, (name, joints) in zip(self.topics, self.joints.items(), strict=True):
            columns = [self._names.index(name) for name in joints]
            rows = np.moveaxis(states[:, :, columns], 1, 0).tolist()
            points = [(tick, *row) for tick, row in zip(ticks.tolist(), rows, strict=True)]
            yield ControllerMotion(name, topic, [self.ros_names[k] for k in columns], points)
