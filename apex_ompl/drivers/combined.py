"""Several drivers as one: arms and hands, or arms of different kinds, whose motions start and stop together."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from apex_ompl.drivers.commands import START_TOLERANCE, Commands
from apex_ompl.drivers.driver import Driver, DriverState
from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.robot.model import Robot
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_positive

WATCH = 0.01  # between two looks at the drivers' faults [s]
LEAD = 0.05  # after which a stop starts [s]


class CombinedDriver:
    """A robot whose joints are driven by several drivers.

    A motion is split by the names of their joints. A stop is that of the motion of all joints, so that they stay on
    its path. Where a driver has a fault or refuses its part of a motion, all are stopped. Its clock is that of the
    first driver; all clocks must go on alike.

    Attributes:
        names: Names of the joints.
        limits: Limits of the joints.
        drivers: The drivers.
    """

    def __init__(
        self, robot: Robot, drivers: Sequence[Driver], *, lead: float = LEAD, watch: float | None = WATCH,
        tolerance: float = START_TOLERANCE,
    ) -> None:  # fmt: skip
        """Take up drivers, whose robots are at rest.

        Args:
            robot: The robot.
            drivers: Drivers of its joints, each of which has one.
            lead: Time after which a stop starts, in which all drivers are told of it [s].
            watch: Time between two looks at the drivers' faults, in a thread of its own; None for looks at calls only,
                as simulated clocks need it [s].
            tolerance: Largest distance of the start of a motion from the commanded position [rad].

        Raises:
            ParameterError: A joint has no driver, or two, or a number is not positive.
            ApexError: A driver does not know its state.
        """
        check_positive(lead, "lead")
        given = [name for driver in drivers for name in driver.names]
        if sorted(given) != sorted(robot.joint_names):
            raise ParameterError("drivers", given, f"each of the joints {', '.join(robot.joint_names)} once")
        self.names, self.limits, self.drivers = robot.joint_names, robot.limits, tuple(drivers)
        self._columns = [[self.names.index(name) for name in driver.names] for driver in drivers]
        self._lead, self._closed, self._lock = lead, False, threading.RLock()
        self._commands = Commands(self.names, self.limits, self._state().positions, tolerance)
        self._ending = threading.Event()
        if watch is not None:
            check_positive(watch, "watch")
            threading.Thread(target=self._run, args=(watch,), daemon=True).start()

    def __repr__(self) -> str:
        """Return the drivers, and whether they are closed."""
        names = ", ".join(type(driver).__name__ for driver in self.drivers)
        return one_line("CombinedDriver", names, "closed" if self._closed else "")

    @property
    def time(self) -> float:
        """Time on the first driver's clock [s]."""
        return self.drivers[0].time

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        return self._commands.end

    @property
    def fault(self) -> str:
        """Why the drivers were stopped, in a sentence; else empty."""
        self._look()
        return self._commands.fault

    def state(self) -> DriverState:
        """Return the measured state, with the oldest stamp of the drivers'."""
        self._check_open()
        self._look()
        return self._state()

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on (:meth:`apex_ompl.drivers.driver.Driver.send`)."""
        self._check_open()
        self._look()
        with self._lock:
            self._commands.send(motion, at, self.time)
            try:
                self._hand_over(motion, at)
            except ApexError as error:
                self._commands.fault = f"a part of the motion was refused: {error}"
                self._stop()
                raise

    def stop(self) -> None:
        """Come to rest within the limits, along the motion that is under way; motions that wait are dropped."""
        self._check_open()
        with self._lock:
            self._stop()

    def recover(self) -> Array:
        """Take up motions again, after all drivers did (:meth:`apex_ompl.drivers.driver.Driver.recover`)."""
        self._check_open()
        self._look()
        with self._lock:
            row = np.empty(len(self.names))
            for driver, columns in zip(self.drivers, self._columns, strict=True):
                row[columns] = driver.recover()
            now = self.time
            return self._commands.recover(DriverState(now, row, np.zeros(len(row))), now)

    def close(self) -> None:
        """Close all drivers; other calls after it raise an ApexError."""
        if not self._closed:
            self._closed = True
            self._ending.set()
            for driver in self.drivers:
                driver.close()

    def _state(self) -> DriverState:
        stamps, q, v = [], np.empty(len(self.names)), np.empty(len(self.names))
        for driver, columns in zip(self.drivers, self._columns, strict=True):
            state = driver.state()
            stamps.append(state.stamp - driver.time + self.time)
            q[columns], v[columns] = state.positions, state.velocities
        return DriverState(min(stamps), q, v)

    def _hand_over(self, motion: Trajectory, at: float) -> None:
        for driver in self.drivers:
            driver.send(motion.selected(driver.names), at + driver.time - self.time)

    def _stop(self) -> None:
        """Stop all together; a driver that does not take its part stops by itself."""
        start = self.time + self._lead
        rest = self._commands.stop(start)
        for driver in self.drivers:
            if not driver.fault:  # or else it stopped already
                try:
                    driver.send(rest.selected(driver.names), start + driver.time - self.time)
                except ApexError:
                    driver.stop()

    def _look(self) -> None:
        """Stop all drivers where one of them has a fault."""
        with self._lock:
            if not self._commands.fault and not self._closed:
                faults = [driver.fault for driver in self.drivers if driver.fault]
                if faults:
                    self._commands.fault = faults[0]
                    self._stop()

    def _run(self, watch: float) -> None:
        while not self._ending.wait(watch):
            self._look()

    def _check_open(self) -> None:
        if self._closed:
            raise ParameterError("driver", "one that was closed", "an open one")
