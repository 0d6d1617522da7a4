"""Runs whose robot is a driver's: the loop and the obstacles react to what the driver measures.

In each period the measured state is compared with the commanded one, a step is decided, and its command, which ends at
rest by a proved stop, is sent to the driver before it holds. A command that comes too late is undone, so that the robot
follows the stop of the one before.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from apex_ompl.drivers.driver import Driver
from apex_ompl.errors import ParameterError
from apex_ompl.kernel.timing import motion_extremes
from apex_ompl.loop.control import RunRecord
from apex_ompl.loop.cycle import Cycle
from apex_ompl.loop.environment import LiveSensor, Observation
from apex_ompl.loop.loop import Command, Loop
from apex_ompl.loop.referee import NEAR_GOAL
from apex_ompl.loop.result import INTERRUPTED
from apex_ompl.moving.context import SAME_TIME
from apex_ompl.robot.model import Robot
from apex_ompl.timing import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.process import running

SAMPLE, POLL = 1e-3, 2e-3  # between two measured states of a driver on a simulated clock, and on the wall clock [s]
TINY = 1e-12  # range of a joint that stays where it is [rad; synergies 0..1]
STANDING = 1000  # periods after which a run ends in which the driver's clock stood still
LATE = "the last {} commands did not reach the driver in time"


def check_driver(driver: Any, robot: Robot, *, simulated: bool) -> None:
    """Check that an object is a driver of a robot.

    Raises:
        ParameterError: It is none, or of other joints, or its clock is not simulated where it is to be.
    """
    attributes, methods = ("names", "time", "end", "fault"), ("state", "send", *(["advance"] if simulated else []))
    known = all(hasattr(driver, name) for name in attributes)
    if not known or not all(callable(getattr(driver, name, None)) for name in methods):
        also = ", and advance, or clock='real'" if simulated else ""
        raise ParameterError("driver", driver, f"a driver with names, time, end, fault, state and send{also}")
    if tuple(driver.names) != robot.joint_names:
        raise ParameterError("driver", ", ".join(driver.names), f"the joints of {robot.name}")


class LiveStream:
    """What a sensor of the caller saw, with times since the start of the run."""

    def __init__(self, sensor: LiveSensor, zero: float = 0.0) -> None:
        """Take a sensor, and the time at which the run starts on its clock [s]."""
        self._sensor, self._zero = sensor, zero

    def observations(self, until: float) -> Sequence[Observation]:
        """Return the observation that the sensor has now [s], if there is one.

        Raises:
            ParameterError: It is no observation.
        """
        found: Any = self._sensor.read(self._zero + until)
        if found is None:
            return ()
        if not isinstance(found, Observation):
            raise ParameterError("sensor", found, "an Observation, or None")
        return (replace(found, stamp=found.stamp - self._zero, received=found.received - self._zero),)


@dataclass(eq=False)
class DrivenRun:
    """A run on a driver's clock.

    Attributes:
        cycle: The control, with the environment.
        driver: The robot.
        zero: Time of its clock at which the run starts [s].
        simulated: Whether the driver's clock stands still until it is advanced.
        tolerance: Largest distance of a joint from where it should be, at which the robot is still followed [rad].
        times: Times of the measured states since the start [s].
        positions: The measured positions, shape (dof,) each.
    """

    cycle: Cycle
    driver: Driver
    zero: float
    simulated: bool
    tolerance: float
    times: list[float] = field(default_factory=list)
    positions: list[Array] = field(default_factory=list)
    _late: int = 0
    _unheard: int = 0  # commands in a row that did not reach the driver
    _silent: bool = False

    def __post_init__(self) -> None:
        """Set up the loop by steps."""
        self.loop, self._last = Loop.around(self.cycle, self.tolerance, self.zero), -math.inf

    def run(self) -> RunRecord:
        """Run until the robot is at rest at a goal, or the run ends otherwise.

        Returns:
            The record. ``measured`` has the distances of the measured from the commanded positions, of the joint that
            is farthest off [rad], and the number of commands that did not reach the driver.
        """
        period, before, still = self.cycle.context.settings.period, -math.inf, 0
        with running(self.cycle.abort):
            while self.loop.record is None:
                try:
                    self._step()
                    self._wait((math.floor(self._last / period + 1e-6) + 1) * period)
                except KeyboardInterrupt:
                    if self.cycle.aborted:
                        raise
                    self.cycle.abort(INTERRUPTED)
                still, before = (still + 1 if self._last <= before else 0), self._last
                if still > STANDING and self.loop.record is None:
                    self.loop.end("the clock of the driver stands still")
        record, end = self.loop.record, self.loop.record.trajectory.duration
        self._wait(end)
        self._settle(record)
        last = max(end, self._last, *self.times[-1:])
        self.cycle.advance(last, self.positions[-1] if self.positions else None)
        return replace(record, measured={**record.measured, **self._figures(record.trajectory)})

    def _settle(self, record: RunRecord) -> None:
        """Wait for the state at the end of the commands, and for a robot that reached a goal to be there.

        States arrive later than they were measured, and a robot follows its commands late. What does not come for
        ``silence`` is not waited for.
        """
        end, goal = record.trajectory.duration, record.trajectory.positions[-1]
        patience = time.monotonic() + self.cycle.context.settings.silence
        while not self.simulated and self.times and time.monotonic() < patience:
            there = not record.reached or np.abs(self.positions[-1] - goal).max() <= NEAR_GOAL
            if self.times[-1] >= end and there:
                break
            time.sleep(POLL)
            self._measured(self.driver.time - self.zero)

    def executed(self) -> Trajectory | None:
        """Return the measured motion, a cubic spline through its states, or None where there are less than two.

        Joints that leave their range by rounding or between states, such as an open hand, are scaled into it.
        """
        times = np.array(self.times)
        rows = np.flatnonzero(times >= 0.0)
        if len(rows) < 2:
            return None
        spline = CubicSpline(times[rows] - times[rows[0]], np.stack(self.positions)[rows])
        states, limits = np.stack([spline(spline.x, order) for order in range(3)]), self.driver.limits
        low, high = motion_extremes((spline.x, *states))[:2]
        least, most = np.clip(low, limits.lower, limits.upper), np.clip(high, limits.lower, limits.upper)
        share = (most - least) / np.maximum(high - low, TINY)
        off = np.flatnonzero((least != low) | (most != high))
        states[:, :, off] *= share[off]
        states[0][:, off] += (least - low * share)[off]
        return Trajectory.unchecked(spline.x, states, self.driver.names)

    def _figures(self, commanded: Trajectory) -> dict[str, float]:
        found = {"late_commands": float(self._late)}
        if self.times:
            wanted = commanded(np.clip(self.times, 0.0, commanded.duration))
            off = np.abs(np.stack(self.positions) - wanted).max(axis=1)
            found["tracking_error_p95"], found["tracking_error"] = np.percentile(off, [95.0, 100.0]).tolist()
        return found

    def _step(self) -> None:
        """Make the step of the present period."""
        now = self.driver.time
        if not math.isfinite(now):
            self.loop.end(f"the time of the driver is {now}")
            self._last = max(self._last, 0.0)
            return
        elapsed = now - self.zero
        positions, stamp = self._measured(elapsed)
        if elapsed >= self._last - SAME_TIME:
            self.cycle.advance(elapsed, positions)
            self.cycle.observe(elapsed)
        self._last = max(elapsed, self._last)
        if self.driver.fault:
            self.cycle.abort(self.driver.fault)
        command = self.loop.step(now, np.full(len(self.driver.names), np.nan) if positions is None else positions,
                                 now if positions is None else stamp)  # fmt: skip
        if command is None:
            return
        sent = False
        try:
            sent = self._send(command)
        finally:
            if not sent:
                self.loop.missed()
        self.cycle.announce_start(command.at - self.zero)
        settings = self.cycle.context.settings
        if self._unheard * settings.period > settings.silence:
            self.cycle.abort(LATE.format(self._unheard))

    def _measured(self, elapsed: float) -> tuple[Array | None, float]:
        """Return the measured positions, None where the driver has none, and their stamp."""
        try:
            state = self.driver.state()
        except Exception as error:  # whatever a driver raises, the robot stops where that lasts
            if not self._silent:
                what = f"{type(error).__name__}: {error}"
                self.cycle.executor.log(max(elapsed, self._last, 0.0), "driver fault", what=what)
            self._silent = True
            return None, math.nan
        self._silent = False
        positions, stamp = np.asarray(state.positions, float), float(state.stamp)
        if positions.shape != (len(self.driver.names),) or not np.isfinite([*positions, stamp]).all():
            return None, math.nan
        since = stamp - self.zero
        if not self.times or since > self.times[-1] + SAME_TIME:
            self.times.append(since)
            self.positions.append(positions)
        return positions, stamp

    def _send(self, command: Command) -> bool:
        """Send a command to the driver, and return whether it came in time; a driver that refuses it ends the run."""
        if command.rests and self.driver.end <= command.at:
            return True  # it rests there anyway
        try:
            self.driver.send(command.motion, command.at)
        except Exception as error:  # whatever a driver raises, the robot follows the stop that it was sent before
            late = self.driver.time > command.at or (isinstance(error, ParameterError) and error.name == "at")
            if not late:
                self.cycle.abort(f"the driver refused a motion, {type(error).__name__}: {error}")
            self._late += 1
            self._unheard += 1
            return False
        self._unheard = 0
        return True

    def _wait(self, until: float) -> None:
        """Wait until a time since the start [s], and take the states that are measured until then."""
        driver: Any = self.driver
        end, before = self.zero + until, -math.inf
        while before < driver.time < end - SAME_TIME:
            before = driver.time
            if self.simulated:
                driver.advance(min(before + SAMPLE, end))
            else:
                time.sleep(max(min(POLL, end - before), 0.0))
            self._measured(driver.time - self.zero)
