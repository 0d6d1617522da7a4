"""A driver that writes a bag of ROS 2: the motions that controllers would get, and the joint states of an exact robot.

The bag is played by ``ros2 bag play`` and shown by RViz and Foxglove; ``trajectory_msgs/JointTrajectory`` messages are
those of :class:`apex_ompl.drivers.Ros2Driver`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.drivers.commands import START_TOLERANCE
from apex_ompl.drivers.controllers import Controllers
from apex_ompl.drivers.guard import Guard
from apex_ompl.drivers.kinematic import KinematicDriver
from apex_ompl.drivers.library import rosbags
from apex_ompl.errors import ParameterError
from apex_ompl.robot.model import Robot
from apex_ompl.timing.files import NANOSECONDS
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_number, check_positive

RATE = 100.0  # of joint states [Hz]
VERSION = 9  # of the bag's metadata
TRAJECTORY, STATE = "trajectory_msgs/msg/JointTrajectory", "sensor_msgs/msg/JointState"
STATES = "/joint_states"


class BagDriver(KinematicDriver):
    """A robot that is exactly where it is commanded to be, and writes what happens to a bag.

    Its time stands still until :meth:`advance`. The bag is complete after :meth:`close`; a folder that is there is
    never overwritten.

    Attributes:
        controllers: The controllers.
        path: Folder of the bag.
    """

    def __init__(
        self, robot: Robot, path: str | PathLike[str], controllers: Mapping[str, Sequence[str]] | str = "arms",
        state: Array | None = None, *, renamed: Mapping[str, str] | None = None, zero: float = 0.0, rate: float = RATE,
        tolerance: float = START_TOLERANCE, guard: Guard | None = None,
    ) -> None:  # fmt: skip
        """Rest in a state, and begin a bag.

        Args:
            robot: The robot.
            path: Folder of the bag, which must not exist.
            controllers: As of :class:`apex_ompl.drivers.Ros2Driver`.
            state: The state, shape (dof,); by default the home of the robot.
            renamed: Names of joints in ROS where they are others, by ours.
            zero: Time in the bag at which the driver's clock starts, since 1970 [s].
            rate: Joint states a second [Hz].
            tolerance: Largest distance of the start of a motion from the commanded position [rad].
            guard: How far the robot may be from its motion.

        Raises:
            MissingFileError: The extra ``bags`` is not installed.
            ParameterError: The folder exists or cannot be made, or the state, a joint or a number is faulty.
        """
        check_positive(rate, "rate", "a positive number of states a second")
        check_number(zero, "zero", 0.0)
        super().__init__(robot, state, tolerance=tolerance, guard=guard)
        self.path = Path(path)
        self.controllers = Controllers(self.names, controllers, renamed)
        bags = rosbags()
        self._types, self._zero, self._spacing = bags.types, round(zero * NANOSECONDS), 1.0 / rate
        try:
            self._writer = bags.Writer(self.path, version=VERSION, storage_plugin=bags.plugin.MCAP)
            self._writer.open()
        except Exception as error:  # of the library, or of the system
            raise ParameterError("path", str(path), f"a folder that can be made: {error}") from error
        topics = {STATES: STATE, **dict.fromkeys(self.controllers.topics, TRAJECTORY)}
        self._connections = {
            topic: self._writer.add_connection(topic, kind, typestore=bags.types) for topic, kind in topics.items()
        }
        self._count = 0
        self._write_states(0.0)

    def advance(self, until: float) -> None:
        """Let the clock go on to a time [s], and write the joint states until then."""
        super().advance(until)
        self._write_states(until)

    def close(self) -> None:
        """Complete the bag; other calls after it raise an ApexError."""
        if not self._closed:
            self._writer.close()
        super().close()

    def _send(self, motion: Trajectory, at: float) -> None:
        super()._send(motion, at)
        self._write_motion(motion, at)

    def _stop(self) -> None:
        self._write_motion(self._commands.stop(self.time), self.time)

    def _stamp(self, time: float) -> Any:
        sec, nanosec = divmod(self._zero + round(time * NANOSECONDS), NANOSECONDS)
        return self._types.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)

    def _header(self, time: float) -> Any:
        return self._types.types["std_msgs/msg/Header"](stamp=self._stamp(time), frame_id="")

    def _write(self, topic: str, kind: str, time: float, message: Any) -> None:
        data = self._types.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], self._zero + round(time * NANOSECONDS), data)

    def _write_motion(self, motion: Trajectory, at: float) -> None:
        types = self._types.types
        for part in self.controllers.parts(motion):
            points = [
                types["trajectory_msgs/msg/JointTrajectoryPoint"](
                    positions=np.array(q), velocities=np.array(v), accelerations=np.array(a), effort=np.empty(0),
                    time_from_start=types["builtin_interfaces/msg/Duration"](*divmod(tick, NANOSECONDS)),
                )
                for tick, q, v, a in part.points
            ]  # fmt: skip
            message = types[TRAJECTORY](header=self._header(at), joint_names=part.joints, points=points)
            self._write(part.topic, TRAJECTORY, self.time, message)

    def _write_states(self, until: float) -> None:
        """Write the joint states up to a time [s] that were not written yet."""
        last = math.floor(until / self._spacing + 1e-9)
        times = np.asarray(np.arange(self._count, last + 1) * self._spacing, np.float64)
        self._count = last + 1
        for time, q, v in zip(times.tolist(), *self._commands.states(times)[:2], strict=True):
            message = self._types.types[STATE](
                header=self._header(time), name=self.controllers.ros_names, position=q + self._pushed, velocity=v,
                effort=np.empty(0),
            )  # fmt: skip
            self._write(STATES, STATE, time, message)
