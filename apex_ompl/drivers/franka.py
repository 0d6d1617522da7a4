"""A driver of Franka's arms, one or more, whose motions start at the same time.

Python does not close the loop at 1 kHz: controllers in C++ do (:mod:`apex_ompl.drivers.franka_arms`), and a process
that has nothing else to do sets their references (:mod:`apex_ompl.drivers.streamer`). A motion reaches it as its knots,
``lead`` or more before it starts.
"""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from multiprocessing import Pipe

import numpy as np

from apex_ompl.drivers.commands import START_TOLERANCE, Commands
from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.franka_arms import JOINTS, FrankaSettings, package_of
from apex_ompl.drivers.guard import Guard, part_of
from apex_ompl.drivers.streamer import Memory, Sent, Spec
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot.dynamics import Dynamics, Load
from apex_ompl.robot.model import Robot
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_positive

STARTED = 20.0  # time to wait for the arms [s]
RECOVERED = 10.0  # time to wait for a recovery [s]
SILENCE = 0.1  # age of the state after which the process counts as silent [s]
SPACING = 0.02  # of inertias along a motion [s]
PROGRAM = "from apex_ompl.drivers.streamer import main; main()"
MEMORY = 1.0  # for which commands are kept [s]


class FrankaDriver:
    """Franka's arms, by the package that speaks to their version.

    Its clock is the system's monotonic one, from the start of the driver on. Hands are driven by a driver of their own
    (:class:`apex_ompl.drivers.combined.CombinedDriver`).

    Attributes:
        names: Names of the joints.
        limits: Limits of the joints.
        package: Name of the package.
    """

    def __init__(
        self, robot: Robot, arms: Mapping[str, Sequence[str]], *, package: str | None = None,
        settings: FrankaSettings | None = None, loads: Sequence[Load] = (), tolerance: float = START_TOLERANCE,
        guard: Guard | None = None, started: float = STARTED,
    ) -> None:  # fmt: skip
        """Connect to the arms, and hold their measured positions.

        Args:
            robot: The robot, with hands or without.
            arms: The seven joints of each arm in order, by the arm's address.
            package: ``panda-python`` for Pandas or ``franky-control`` for the Research 3; by default the one that is
                installed.
            settings: Settings of the controllers.
            loads: What the arms carry besides the robot's links, for the feedforward torques of ``franky-control``.
            tolerance: Largest distance of the start of a motion from the commanded position [rad].
            guard: How far the arms may be from their motion.
            started: Time to wait for the arms [s].

        Raises:
            MissingFileError: The package is not installed.
            ParameterError: A joint is unknown or given twice, or an arm has not seven of them.
            DriverError: An arm does not answer, refuses, or is outside its limits.
        """
        check_positive(started, "started")
        self._settings, self._robot = settings or FrankaSettings(), robot
        if {len(joints) for joints in arms.values()} != {JOINTS}:
            raise ParameterError("arms", dict(arms), "seven joints of each arm")
        part = part_of(robot, [name for joints in arms.values() for name in joints], guard)
        self.names, self.limits, self._columns, bounds = part
        self.package = package_of(package)
        self._dynamics = Dynamics(robot, loads)
        self._closed, self._lock, self._zero = False, threading.Lock(), time.monotonic()
        spec = Spec(self.package, tuple(arms), self._settings, self.names, self.limits, bounds, self._zero)
        atexit.register(self.close)
        try:
            self._start(spec)
            start = self._answer("ready", started).positions
        except BaseException:
            self.close()
            raise
        self._commands = Commands(self.names, self.limits, start, tolerance, bounds)
        outside = (start < self.limits.lower) | (start > self.limits.upper)
        if outside.any():
            self.close()
            k = int(np.argmax(outside))
            low, high = self.limits.lower[k], self.limits.upper[k]
            raise DriverError(f"{self.names[k]} is at {start[k]:.4g}, outside its limits [{low:.4g}, {high:.4g}]")

    def __repr__(self) -> str:
        """Return the package, the number of joints, and whether the driver is closed."""
        return one_line("FrankaDriver", self.package, f"{len(self.names)} joints", "closed" if self._closed else "")

    @property
    def time(self) -> float:
        """Time on the driver's clock [s]."""
        return time.monotonic() - self._zero

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        self._hear()
        return self._commands.end

    @property
    def fault(self) -> str:
        """Why the driver stopped, in a sentence; else empty."""
        self._hear()
        return self._commands.fault

    @property
    def late(self) -> tuple[int, int]:
        """Number of cycles in which references were set more than 2 ms late, and of all cycles."""
        _, cycles, late = self._memory.read()
        return late, cycles

    def state(self) -> DriverState:
        """Return the last measured state.

        Raises:
            DriverError: It is older than 0.1 s, or the process ended.
        """
        self._check_open()
        state, _, _ = self._memory.read()
        age = self.time - state.stamp
        if self._process.poll() is not None or age > SILENCE:
            raise DriverError(f"the process that drives the arms was silent for {age:.3g} s")
        return state

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on (:meth:`apex_ompl.drivers.driver.Driver.send`), ``lead`` or more ahead."""
        self._check_open()
        self._hear()
        with self._lock:
            self._commands.send(motion, at, self.time + self._settings.lead, self.state())
            self._hand_over(motion, at)

    def stop(self) -> None:
        """Come to rest within the limits, along the motion that is under way; motions that wait are dropped."""
        self._check_open()
        self._hear()
        with self._lock:
            start = self.time + self._settings.lead
            self._hand_over(self._commands.stop(start), start)

    def recover(self) -> Array:
        """Recover the arms from errors, hold their measured positions, and take up motions again.

        Raises:
            DriverError: The robot moves, or an arm cannot be recovered.
        """
        self._check_open()
        self._hear()
        with self._lock:
            self._connection.send(("recover",))
            state = self._answer("recovered", RECOVERED)
            return self._commands.recover(state, state.stamp)

    def close(self) -> None:
        """Leave the arms to the motion that they follow, and end their controllers at its end."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        if not hasattr(self, "_process"):
            return
        wait = self._commands.end - self.time if hasattr(self, "_commands") else 0.0
        self._connection.close()
        try:
            self._process.wait(max(wait, 0.0) + RECOVERED)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _start(self, spec: Spec) -> None:
        self._connection, other = Pipe()
        descriptor = os.memfd_create("apex_ompl")
        os.set_inheritable(descriptor, True)
        self._memory = Memory(descriptor, len(spec.names))
        passed = other.fileno(), descriptor
        command = [sys.executable, "-c", PROGRAM, *map(str, passed)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(one for one in sys.path if one)}
        self._process = subprocess.Popen(command, pass_fds=passed, env=environment, start_new_session=True)
        other.close()
        os.close(descriptor)
        self._connection.send(spec)

    def _answer(self, wanted: str, most: float) -> DriverState:
        """Wait for an answer of the process, and return the state that comes with it."""
        end = time.monotonic() + most
        while self._connection.poll(max(end - time.monotonic(), 0.0)):
            try:
                kind, *rest = self._connection.recv()
            except (EOFError, OSError) as error:
                raise DriverError("the process that drives the arms ended") from error
            if kind == wanted:
                found: DriverState = rest[0]
                return found
            if kind == "fault":
                self._take(*rest)
            else:
                raise DriverError(rest[0])
        raise DriverError(f"the arms did not answer in {most:g} s")

    def _hear(self) -> None:
        """Take up what the process said meanwhile."""
        with self._lock:
            try:
                while not self._closed and self._connection.poll():
                    kind, *rest = self._connection.recv()
                    assert kind == "fault"
                    self._take(*rest)
            except (EOFError, OSError):
                self._commands.fault = self._commands.fault or "the process that drives the arms ended"

    def _take(self, fault: str, stop: Sent) -> None:
        self._commands.fault = fault
        self._commands.add(stop.motion, stop.at)

    def _hand_over(self, motion: Trajectory, at: float) -> None:
        self._commands.forget(self.time - MEMORY)
        times = np.append(np.arange(0.0, motion.duration, SPACING), motion.duration)
        states = np.tile(self._robot.home, (len(times), 1))
        states[:, self._columns] = motion.states(times)[0]
        whole = self._dynamics.inertias(states)[:, self._columns][:, :, self._columns]
        arms = range(0, len(self.names), JOINTS)
        inertias = np.stack([whole[:, k : k + JOINTS, k : k + JOINTS] for k in arms], axis=1)
        try:
            self._connection.send(("motion", Sent(motion, at, inertias, SPACING)))
        except OSError as error:
            raise DriverError("the process that drives the arms ended") from error

    def _check_open(self) -> None:
        if self._closed:
            raise ParameterError("driver", "one that was closed", "an open one")
