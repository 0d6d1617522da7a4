"""A driver of joints whose positions a function of the caller's sets, such as the synergies of hands."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

from apex_ompl.drivers.commands import START_TOLERANCE
from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.guard import Guard, part_of
from apex_ompl.drivers.kinematic import KinematicDriver
from apex_ompl.robot.model import Robot
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_positive, finite_array

RATE = 100.0  # of commands [Hz]


class FunctionDriver(KinematicDriver):
    """Joints whose positions a function of the caller's sets, at a rate, in a thread of its own.

    Where the process is killed, the joints stay where they were commanded last.
    """

    def __init__(
        self, robot: Robot, joints: Sequence[str], command: Callable[[Array], None],
        measure: Callable[[], Array] | None = None, *, rate: float = RATE, clock: Callable[[], float] = time.monotonic,
        tolerance: float = START_TOLERANCE, guard: Guard | None = None,
    ) -> None:  # fmt: skip
        """Command the measured positions.

        Args:
            robot: The robot.
            joints: Names of the joints.
            command: Is given their positions, shape (joints,) [rad; synergies 0..1].
            measure: Returns the measured ones; without it they are taken to be the commanded ones, at first those of
                the robot's home.
            rate: Commands a second [Hz].
            clock: Returns the time, which never decreases [s].
            tolerance: Largest distance of the start of a motion from the commanded position [rad].
            guard: How far the joints may be from their motion.

        Raises:
            ParameterError: A joint is unknown or given twice, a number is not positive, or the measured positions have
                another shape or are outside the limits.
        """
        check_positive(rate, "rate", "a positive number of commands a second")
        self._command, self._measure, self._period = command, measure, 1.0 / rate
        state, columns = robot.home.copy(), part_of(robot, joints, guard).columns
        if measure is not None:
            found = finite_array(measure(), "measure")
            check_array(found, (len(columns),), "measure")
            state[columns] = found
        super().__init__(robot, state, clock=clock, tolerance=tolerance, guard=guard, joints=joints)
        self._speeds, self._last = np.zeros(len(columns)), self._now_measured(self.time)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Follow the motion that is under way to its end; other calls after it raise an ApexError."""
        if not self._closed:
            self._ending.set()
            self._thread.join()
        super().close()

    def _measured(self, now: float) -> DriverState:
        return super()._measured(now) if self._measure is None else self._last

    def _now_measured(self, now: float) -> DriverState:
        """Ask for the measured positions; velocities are those between two of them."""
        if self._measure is None:
            return super()._measured(now)
        found = np.array(self._measure(), np.float64)
        check_array(found, (len(self.names),), "measure")
        return DriverState(now, found, np.zeros(len(found)))

    def _run(self) -> None:
        while not (self._ending.is_set() and self.time >= self._commands.end):
            with self._lock:
                self._cycle(self.time)
            time.sleep(self._period)
        with self._lock:
            self._cycle(self.time)  # the end of the motion

    def _cycle(self, now: float) -> None:
        """Command, measure, and stop where the joints are off or a function fails."""
        try:
            self._command(self._commands.states(np.array([now]))[0, 0])
            before, last = self._last, self._now_measured(now)
            since = now - before.stamp
            speeds = (last.positions - before.positions) / since if since > 0.0 else before.velocities
            self._last = DriverState(now, last.positions, speeds)
        except Exception as error:  # of the caller's functions
            if not self._commands.fault:
                self._commands.fault = f"commands of {', '.join(self.names)} failed: {error}"
                self._stop()
            return
        if self._commands.watch(self._last):
            self._stop()
