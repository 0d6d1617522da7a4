"""A driver whose robot is exactly where it is commanded to be, on the wall clock or on a simulated one."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence

import numpy as np

from apex_ompl.drivers.commands import START_TOLERANCE, Commands
from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.guard import Guard, part_of
from apex_ompl.errors import ParameterError
from apex_ompl.robot.model import Robot
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_array, check_number, finite_array


class KinematicDriver:
    """A robot that is exactly where it is commanded to be, and off by as much as it was pushed (:meth:`push`).

    Without a clock of the caller's its time stands still until :meth:`advance`. Its methods may be called from several
    threads.

    Attributes:
        names: Names of the joints.
        limits: Limits of the joints.
    """

    def __init__(
        self, robot: Robot, state: Array | None = None, *, clock: Callable[[], float] | None = None,
        tolerance: float = START_TOLERANCE, guard: Guard | None = None, joints: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        """Rest in a state.

        Args:
            robot: The robot.
            state: The state of all joints, shape (dof,); by default the home of the robot.
            clock: Returns the time, which never decreases [s], such as ``time.monotonic``.
            tolerance: Largest distance of the start of a motion from the commanded position [rad].
            guard: How far the robot may be from its motion.
            joints: The joints that it drives; by default all.

        Raises:
            ParameterError: A joint is unknown or given twice, or the state has another shape or a number that is not
                finite, or is outside the limits.
        """
        at = finite_array(robot.home if state is None else state, "state")
        check_array(at, (robot.dof,), "state")
        part = part_of(robot, joints, guard)
        self.names, self.limits = part.names, part.limits
        self._commands = Commands(part.names, part.limits, at[part.columns], tolerance, part.bounds)
        self._pushed = np.zeros(len(part.names))
        fault = robot.limit_fault(at)
        if fault:
            raise ParameterError("state", fault, "a state within the limits")
        self._clock, self._time, self._closed = clock, 0.0, False
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        """Return the time, and whether the driver is closed."""
        return one_line(type(self).__name__, f"{self.time:.3f} s", "closed" if self._closed else "")

    @property
    def time(self) -> float:
        """Time on the driver's clock [s]."""
        return self._time if self._clock is None else self._clock()

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        with self._lock:
            return self._commands.end

    def advance(self, until: float) -> None:
        """Let the simulated clock go on to a time [s].

        Raises:
            ParameterError: The time is over, or the clock is the caller's.
        """
        with self._open():
            check_number(until, "until", self._time, math.inf)
            if self._clock is not None:
                raise ParameterError("until", until, "no call: the clock is the caller's")
            self._time = until

    @property
    def fault(self) -> str:
        """Why the driver stopped, in a sentence; else empty."""
        with self._lock:  # so that the stop is commanded where there is a fault
            return self._commands.fault

    def state(self) -> DriverState:
        """Return the commanded state, off by as much as the robot was pushed."""
        with self._open():
            now = self.time
            self._commands.forget(now)
            return self._measured(now)

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on (:meth:`apex_ompl.drivers.driver.Driver.send`)."""
        with self._open():
            self._send(motion, at)

    def stop(self) -> None:
        """Come to rest within the limits, along the motion that is under way; motions that wait are dropped."""
        with self._open():
            self._stop()

    def push(self, by: Array) -> None:
        """Push the robot off its commanded position, as somebody might: what watches a robot is tested so.

        Args:
            by: How far it is off from now on, shape (dof,) [rad; synergies 0..1].

        Raises:
            ParameterError: It has another shape.
        """
        with self._open():
            check_array(np.asarray(by), (len(self.names),), "by")
            self._pushed = np.array(by, np.float64)  # NaN as of a sensor that fails
            if self._commands.watch(self._measured(self.time)):
                self._stop()

    def recover(self) -> Array:
        """Rest where the robot is, and take up motions again (:meth:`apex_ompl.drivers.driver.Driver.recover`)."""
        with self._open():
            now = self.time
            found = self._commands.recover(self._measured(now), now)
            self._pushed[:] = 0.0
            return found

    def close(self) -> None:
        """End it; other calls after it raise an ApexError."""
        self._closed = True

    def _measured(self, now: float) -> DriverState:
        position, velocity, _ = self._commands.states(np.array([now]))[:, 0]
        return DriverState(now, position + self._pushed, velocity)

    def _send(self, motion: Trajectory, at: float) -> None:
        now = self.time
        self._commands.send(motion, at, now, self._measured(now))

    def _stop(self) -> None:
        self._commands.stop(self.time)

    def _open(self) -> threading.RLock:
        if self._closed:
            raise ParameterError("driver", "one that was closed", "an open one")
        return self._lock
