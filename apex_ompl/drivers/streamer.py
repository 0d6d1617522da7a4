"""The process that sets the references of Franka's arms, a thousand times a second, from motions that it is sent ahead.

It has nothing else to do, so that no garbage collection and no planner delays it, and it outlives the process that
sends motions: where that one is killed, the motion under way is followed to its end at rest. The loop at 1 kHz is
closed by the controllers in C++; a reference that is late is held there, with its velocity.
"""

from __future__ import annotations

import gc
import mmap
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from apex_ompl.drivers.commands import Commands
from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.franka_arms import JOINTS, Arm, FrankaSettings, connect
from apex_ompl.drivers.guard import Bounds
from apex_ompl.robot.model import Limits
from apex_ompl.timing.parameterization import time_path
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array

MARGIN = 0.005  # after which a stop starts, in which it is computed [s]
NUMBERS = 4  # in the shared memory before the state: its sequence number, stamp, cycles, late cycles
LATE = 0.002  # by which a cycle counts as late [s]
PRIORITY = 40  # below that of the control loops in C++


@dataclass(frozen=True, eq=False)
class Spec:
    """What the process is to drive.

    Attributes:
        package: Name of the package.
        addresses: Addresses of the arms.
        settings: Settings of their controllers.
        names: Names of the joints, seven of each arm.
        limits: Limits of the joints.
        bounds: How far the robot may be from its motion.
        zero: Time of the clock at which that of the driver is 0 [s].
    """

    package: str
    addresses: tuple[str, ...]
    settings: FrankaSettings
    names: tuple[str, ...]
    limits: Limits
    bounds: Bounds
    zero: float


@dataclass(frozen=True, eq=False)
class Sent:
    """A motion, when it starts [s], and inertias of the arms along it.

    Attributes:
        motion: The motion.
        at: When it starts [s].
        inertias: M(q) of each arm at ``spacing`` from the start of the motion on, shape (N, arms, 7, 7) [kg m^2].
        spacing: Time between them [s].
    """

    motion: Trajectory
    at: float
    inertias: Array
    spacing: float


class Memory:
    """A state that one process writes, and another one reads without a lock."""

    def __init__(self, descriptor: int, dof: int) -> None:
        """Map the memory of a file descriptor."""
        size = 8 * (NUMBERS + 2 * dof)
        os.ftruncate(descriptor, size)
        self._row = np.frombuffer(mmap.mmap(descriptor, size), np.float64)
        self._dof = dof

    def write(self, state: DriverState, cycles: int, late: int) -> None:
        """Write a state."""
        row = self._row
        row[0] += 1.0  # odd while the others change
        row[1:NUMBERS] = state.stamp, cycles, late
        row[NUMBERS : NUMBERS + self._dof], row[NUMBERS + self._dof :] = state.positions, state.velocities
        row[0] += 1.0

    def read(self) -> tuple[DriverState, int, int]:
        """Return the last state, and the numbers of cycles and of late ones."""
        while True:
            before = self._row[0]
            row = self._row.copy()
            if before == self._row[0] and before % 2.0 == 0.0:
                q, v = row[NUMBERS:].reshape(2, self._dof)
                return DriverState(float(row[1]), q, v), int(row[2]), int(row[3])


class Streamer:
    """What the process does in a cycle.

    Attributes:
        commands: What is commanded.
    """

    def __init__(self, spec: Spec, arms: Sequence[Arm], now: float) -> None:
        """Hold the measured position from a time on [s]."""
        self._spec, self._arms = spec, arms
        self._half = 0.5 / spec.settings.rate
        self._ended, self._new = [False] * len(arms), False
        for arm in arms:
            arm.start()
        self._sent: list[Sent] = []
        self._measured = np.zeros((2, len(spec.names)))
        self.commands = Commands(spec.names, spec.limits, self._now_measured(now).positions, bounds=spec.bounds)

    def measure(self, now: float) -> DriverState:
        """Return the state of all arms; that of an arm whose controller ended is its last one."""
        for k, arm in enumerate(self._arms):
            if not self._ended[k]:
                with self._failing(k):
                    self._measured[:, _part(k)] = arm.state()
        return DriverState(now, *self._measured.copy())

    def take(self, sent: Sent) -> None:
        """Follow a motion, unless there is a fault."""
        if not self.commands.fault:
            self.commands.add(sent.motion, sent.at)
            self._sent = [*(one for one in self._sent if one.at < sent.at), sent]

    def step(self, now: float) -> tuple[DriverState, Sent | None]:
        """Set the references for a cycle that starts now [s], in its middle, and compare the measured state.

        Returns:
            The state, and the stop where there is a fault now.
        """
        middle = now + self._half
        q, v, a = self.commands.states(np.array([middle]))[:, 0]
        torques = (self._inertia(middle) @ a.reshape(-1, JOINTS, 1)).ravel()
        for k, arm in enumerate(self._arms):
            part = _part(k)
            if not self._ended[k]:
                with self._failing(k):
                    arm.command(q[part], v[part], torques[part])
        state = self.measure(now)
        self.commands.forget(now - MARGIN)
        ended = self._any_ended()
        return state, self._stop(now) if self.commands.watch(state) or ended else None

    def recover(self, now: float) -> DriverState:
        """Recover the arms, hold the measured position from a time on [s], and return the state.

        Raises:
            ApexError: The robot moves.
            Exception: One of the package.
        """
        self.commands.recover(self._now_measured(now), now)
        self._sent = []
        for k, arm in enumerate(self._arms):
            arm.recover()
            self._ended[k] = False
        state = self.measure(now)
        self.commands.recover(state, now)
        return state

    def finish(self) -> None:
        """End the controllers."""
        for k, arm in enumerate(self._arms):
            if not self._ended[k]:
                arm.finish()

    def _now_measured(self, now: float) -> DriverState:
        for k, arm in enumerate(self._arms):
            self._measured[:, _part(k)] = arm.state()
        return DriverState(now, *self._measured.copy())

    def _any_ended(self) -> bool:
        """Return whether the controller of an arm ended now."""
        for k, arm in enumerate(self._arms):
            if not self._ended[k]:
                with self._failing(k):
                    error = arm.error()
                    if error:
                        self._end(k, error)
        found, self._new = self._new, False
        return found

    @contextmanager
    def _failing(self, k: int) -> Iterator[None]:
        """Take an error of an arm's package to be the end of its controller."""
        try:
            yield
        except Exception as error:  # of the package
            self._end(k, str(error))

    def _end(self, k: int, why: str) -> None:
        self._ended[k] = self._new = True
        self.commands.fault = self.commands.fault or f"the arm at {self._spec.addresses[k]}: {why}"

    def _stop(self, now: float) -> Sent:
        start = now + MARGIN
        inertia = self._inertia(start)
        sent = Sent(self.commands.stop(start), start, inertia[None], 1.0)
        self._sent = [*(one for one in self._sent if one.at < start), sent]
        return sent

    def _inertia(self, now: float) -> Array:
        """Return the inertias of the arms at a time [s], shape (arms, 7, 7)."""
        while len(self._sent) > 1 and self._sent[1].at <= now:
            self._sent.pop(0)
        if not self._sent:
            return np.zeros((len(self._arms), JOINTS, JOINTS))
        sent = self._sent[0]
        k = round((now - sent.at) / sent.spacing)
        found: Array = sent.inertias[min(max(k, 0), len(sent.inertias) - 1)]
        return found


def _part(k: int) -> slice:
    """Return where the joints of an arm are."""
    return slice(JOINTS * k, JOINTS * (k + 1))


class _Client:
    """The driver, in another process, which may be gone."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self.gone = connection, False

    def say(self, *message: Any) -> None:
        try:
            self._connection.send(message)
        except OSError:
            self.gone = True

    def heard(self) -> tuple[Any, ...] | None:
        try:
            return self._connection.recv() if not self.gone and self._connection.poll() else None
        except (EOFError, OSError):
            self.gone = True
            return None


def _stream(streamer: Streamer, client: _Client, memory: Memory, spec: Spec, clock: Callable[[], float]) -> None:
    """Set references until the driver is closed or killed, and the motion under way has ended."""
    period, cycles, late = 1.0 / spec.settings.rate, 0, 0
    due = clock()
    while not (client.gone and due > streamer.commands.end):
        now = clock()
        state, stop = streamer.step(now)
        memory.write(state, cycles, late)
        if stop is not None:
            client.say("fault", streamer.commands.fault, stop)
        message = client.heard()
        if message is not None and message[0] == "motion":
            streamer.take(message[1])
        elif message is not None and message[0] == "recover":
            try:
                client.say("recovered", streamer.recover(clock()))
            except Exception as error:  # of the package, or that the robot moves
                client.say("unrecovered", str(error))
        cycles += 1
        due += period
        wait = due - clock()
        if wait > 0.0:
            time.sleep(wait)
        elif wait < -LATE:
            late += 1
            due = clock()
    streamer.step(clock())  # the end of the motion


def main() -> None:
    """Connect to the arms, and set their references; the program's arguments are a connection and a memory."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the driver, which closes
    connection = Connection(int(sys.argv[1]))
    spec: Spec = connection.recv()
    client, memory = _Client(connection), Memory(int(sys.argv[2]), len(spec.names))

    def clock() -> float:
        return time.monotonic() - spec.zero

    try:
        arms = [connect(spec.package, address, spec.settings) for address in spec.addresses]
        streamer = Streamer(spec, arms, clock())
    except Exception as error:  # of the package
        client.say("failed", str(error))
        return
    _prepare(streamer, spec, clock())
    memory.write(streamer.measure(clock()), 0, 0)
    client.say("ready", streamer.measure(clock()))
    try:
        _stream(streamer, client, memory, spec, clock)
    finally:
        streamer.finish()


def _prepare(streamer: Streamer, spec: Spec, now: float) -> None:
    """Load what a stop needs, and take as much priority as the system gives."""
    q = streamer.commands.states(np.array([now]))[0, 0]
    inward = q + 1e-2 * (spec.limits.lower + spec.limits.upper - 2.0 * q)
    motion = time_path(np.stack([q, inward]), spec.limits, spec.names).trajectory
    motion.stop_at(0.5 * motion.duration, spec.limits)
    gc.collect()
    gc.freeze()
    gc.disable()
    if spec.settings.realtime:
        with suppress(OSError):  # without the right to
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
