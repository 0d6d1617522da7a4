"""The protocol of drivers: how a motion reaches a robot, and how its state comes back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from apex_ompl.robot.model import Limits
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array


@dataclass(frozen=True, eq=False)
class DriverState:
    """Measured state of a robot.

    Attributes:
        stamp: Time of the measurement on the driver's clock [s].
        positions: Positions of the joints, shape (dof,) [rad; synergies 0..1].
        velocities: Velocities of the joints, shape (dof,) [rad/s].
    """

    stamp: float
    positions: Array
    velocities: Array


class Driver(Protocol):
    """A robot that follows motions. At the start, and after the end of a motion, it is at rest.

    Where the measured position is further from the commanded one than the driver's guard allows
    (:class:`apex_ompl.drivers.guard.Guard`), or where a part of the robot fails, the driver stops as :meth:`stop`
    does, :attr:`fault` says why, and motions are refused until :meth:`recover`.

    Attributes:
        names: Names of the joints, in the order of states.
        limits: Limits of the joints, which each motion must keep.
        time: Time on the driver's clock [s].
    """

    names: tuple[str, ...]
    limits: Limits

    @property
    def time(self) -> float:
        """Time on the driver's clock [s]."""
        ...

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        ...

    @property
    def fault(self) -> str:
        """Why the driver stopped, in a sentence; else empty."""
        ...

    def state(self) -> DriverState:
        """Return the measured state."""
        ...

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on; it replaces what was commanded afterwards.

        Args:
            motion: The motion, which ends at rest.
            at: Time of its start on the driver's clock, now or later [s].

        Raises:
            ApexError: The time is over, or the motion is of other joints, has a number that is not finite, exceeds the
                limits, does not end at rest, or does not start in the state that is commanded then, or the robot is
                further from its start than the guard allows, or there is a fault.
        """
        ...

    def stop(self) -> None:
        """Come to rest within the limits, along the motion that is under way; motions that wait are dropped."""
        ...

    def recover(self) -> Array:
        """Take up motions again after a fault.

        Returns:
            The position in which the next motion starts, shape (dof,): the measured one, where the robot can be
            commanded to rest there.

        Raises:
            ApexError: The robot moves, or cannot be commanded.
        """
        ...

    def close(self) -> None:
        """Release what the driver holds; other calls after it raise an ApexError."""
        ...
