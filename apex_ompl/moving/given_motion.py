"""The given motion of some joints while others are planned: that of another arm, with what it holds."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory
from apex_ompl.timing.knots import union
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_name, check_number


@dataclass(frozen=True, eq=False)
class GivenMotion:
    """A motion of some of a robot's joints from the start of a plan on; it ends at rest, and its last state holds.

    Attributes:
        robot: The robot.
        motion: The motion of these joints.
        columns: Their numbers in the robot's order, shape (given,).
    """

    robot: Robot
    motion: Trajectory
    columns: NDArray[np.intp]

    @classmethod
    def of(cls, robot: Robot, motion: Trajectory, offset: float = 0.0) -> GivenMotion:
        """Return a motion as it is from a time on.

        Args:
            robot: The robot.
            motion: A motion of some of its joints, or of all; of the latter only joints that move are given.
            offset: Time of the motion at which the plan starts [s]; where it is negative the motion starts later.

        Raises:
            ParameterError: It is no motion, it does not end at rest, or it starts later and moves at its start.
            UnknownNameError: The robot has not one of its joints.
        """
        if not isinstance(motion, Trajectory):
            raise ParameterError("while_executing", motion, "a Trajectory of joints of the robot")
        for name in motion.joint_names:
            check_name(name, f"joint of {robot.name} in while_executing", robot.joint_names)
        check_number(offset, "offset")
        if np.any(motion.velocities[-1]) or np.any(motion.accelerations[-1]):
            raise ParameterError("while_executing", "a motion that is not at rest at its end", "one that is")
        names = motion.joint_names
        if len(names) == robot.dof:
            moves = np.ptp(motion.positions, axis=0) + np.abs(motion.velocities).max(axis=0) > 0.0
            names = tuple(name for name, one in zip(names, moves, strict=True) if one)
        order = tuple(name for name in robot.joint_names if name in names)
        columns = np.array([robot.joint_names.index(name) for name in order], np.intp)
        chosen = motion.selected(order or names or motion.joint_names[:1])
        return cls(robot, _later(chosen, -offset) if offset < 0.0 else chosen.after(offset), columns)

    def __repr__(self) -> str:
        """Return the joints and the duration."""
        return one_line("GivenMotion", ", ".join(self.joint_names), f"{self.duration:.3f} s")

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(self.robot.joint_names[k] for k in self.columns)

    @property
    def duration(self) -> float:
        """Time until it rests [s]."""
        return self.motion.duration

    def check_apart(self, planned: Collection[str]) -> None:
        """Check that none of its joints is planned.

        Raises:
            ParameterError: One is.
        """
        both = [name for name in self.joint_names if name in planned]
        if both:
            raise ParameterError("group", ", ".join(both), "joints that while_executing does not move")

    def at(self, time: float) -> dict[str, float]:
        """Return the values of the joints at a time [s], by name."""
        return dict(zip(self.joint_names, self._values(np.array([time]))[0, 0].tolist(), strict=True))

    def placed(self, states: Array, time: float) -> Array:
        """Return states, shape (..., dof), with the values that the joints have at a time [s]."""
        found = np.array(states, float)
        found[..., self.columns] = self._values(np.array([time]))[0, 0]
        return found

    def values(self, times: Array) -> Array:
        """Return the values of the joints at times, shape (N,) [s], NaN of the other joints, shape (N, dof)."""
        found = np.full((len(times), self.robot.dof), np.nan)
        found[:, self.columns] = self._values(times)[0]
        return found

    def combined(self, own: Trajectory) -> Trajectory:
        """Return a motion of all joints with the given values, to the later end of the two.

        Args:
            own: Motion of all joints; values of the given ones are replaced.
        """
        times = union(own.times, self.motion.times)
        states = own.states(times)
        for k in (0, -1):  # exact where it ends
            if times[k] == own.times[k]:
                states[:, k] = own.positions[k], own.velocities[k], own.accelerations[k]
        if len(self.columns):
            states[:, :, self.columns] = self._values(times)
        return Trajectory(times, states[0], states[1], states[2], own.joint_names)

    def _values(self, times: Array) -> Array:
        """Return positions, velocities and accelerations of the joints, shape (3, N, given)."""
        return self.motion.states(times)[:, :, : len(self.columns)]


def _later(motion: Trajectory, by: float) -> Trajectory:
    """Return a motion that starts some time later [s], after a rest.

    Raises:
        ParameterError: It moves at its start.
    """
    if np.any(motion.velocities[0]) or np.any(motion.accelerations[0]):
        raise ParameterError("offset", -by, "0 or more, since the motion is not at rest at its start")
    q, v, a = (np.concatenate([rows[:1], rows]) for rows in (motion.positions, motion.velocities, motion.accelerations))
    return Trajectory(np.append(0.0, motion.times + by), q, v, a, motion.joint_names)
