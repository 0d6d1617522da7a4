"""The motions that were sent to a driver, the state that they command at a time, and how far the robot is from it."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.guard import STILL, Bounds
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot.model import Limits
from apex_ompl.timing.rests import AT_REST
from apex_ompl.timing.trajectory import LIMIT_ROOM, Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_positive, finite_array

START_TOLERANCE = 1e-3
"""Largest distance of the start of a motion from the commanded position [rad; synergies 0..1]."""
RATE_SHARE = 1e-3  # the same of velocity and acceleration, as a share of their limits
CLOCK_ROUNDING = 1e-9  # by which a time may be over [s]
SETTLING = 0.1  # after its motion, for which a robot may be as far off as during it [s]


class Commands:
    """Motions by the times at which they start: each replaces the earlier ones from its start on.

    Attributes:
        names: Names of the joints.
        limits: Limits that motions keep.
        tolerance: Largest distance of the start of a motion from the commanded position [rad].
        fault: Where the robot left its motion, in a sentence, after which motions are refused; else empty.
    """

    def __init__(
        self, names: tuple[str, ...], limits: Limits, position: Array, tolerance: float = START_TOLERANCE,
        bounds: Bounds | None = None,
    ) -> None:  # fmt: skip
        """Command rest at a position, shape (dof,), from time 0 on, for a robot that is guarded by ``bounds``.

        Raises:
            ParameterError: The position has another shape or a number that is not finite, or the tolerance is not a
                positive number.
        """
        self.names, self.limits = names, limits
        self.tolerance, self.fault = tolerance, ""
        self._bounds = bounds
        check_positive(tolerance, "tolerance")
        self._starts, self._motions = [0.0], [self._still(position)]

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        return self._starts[-1] + self._motions[-1].duration

    def states(self, times: Array) -> Array:
        """Return positions, velocities and accelerations at increasing times, shape (N,) [s], in one, (3, N, dof)."""
        found = np.empty((3, len(times), len(self.names)))
        first = [*np.searchsorted(times, self._starts[1:]).tolist(), len(times)]
        begin = 0
        for start, motion, end in zip(self._starts, self._motions, first, strict=True):
            if end > begin:
                found[:, begin:end] = motion.states(np.maximum(times[begin:end] - start, 0.0))
            begin = max(begin, end)
        return found

    def send(self, motion: Trajectory, at: float, now: float, measured: DriverState | None = None) -> None:
        """Add a motion (:meth:`apex_ompl.drivers.driver.Driver.send`); the time is ``now`` [s]."""
        if self.fault:
            raise DriverError(f"the robot was stopped, since {self.fault}; recover() takes up motions again")
        at = float(finite_array(at, "at"))
        if at < now - CLOCK_ROUNDING:
            raise ParameterError("at", at, f"a time that is not over, {now:g} s or later")
        self._check(motion)
        self._check_start(motion, at)
        if measured is not None and self._bounds is not None:
            self._check_measured(motion, at, measured, self._bounds)
        self.add(motion, at)

    def add(self, motion: Trajectory, at: float) -> None:
        """Replace what is commanded from a time on [s] by a motion that was checked."""
        kept = bisect_right(self._starts, at - CLOCK_ROUNDING)
        self._starts[kept:], self._motions[kept:] = [at], [motion]

    def stop(self, at: float) -> Trajectory:
        """Come to rest along the motion that is under way at a time, from that time on [s], and drop those that wait.

        Returns:
            The stop.
        """
        k = max(bisect_right(self._starts, at) - 1, 0)
        motion, since = self._motions[k], at - self._starts[k]
        del self._starts[k + 1 :], self._motions[k + 1 :]
        if not 0.0 <= since < motion.duration:
            return motion.after(max(since, 0.0))
        rest = motion.after(since).stop_at(0.0, self.limits)
        self._starts.append(at)
        self._motions.append(rest)
        return rest

    def watch(self, measured: DriverState) -> bool:
        """Compare a measured state with the one that is commanded at its stamp, and set :attr:`fault` where it is off.

        Returns:
            Whether it is, for the first time: the robot is to be stopped.
        """
        if self.fault or self._bounds is None:
            return False
        off = np.abs(measured.positions - self.states(np.array([measured.stamp]))[0, 0])
        if (off <= self._bounds.tracking).all():
            return False
        k = int(np.argmax(off / self._bounds.tracking))
        most = f"more than {self._bounds.tracking[k]:g}"
        self.fault = f"{self.names[k]} was {off[k]:.3g} off its commanded position at {measured.stamp:.3f} s, {most}"
        return True

    def recover(self, measured: DriverState, now: float, adopt: bool = True) -> Array:
        """Forget the fault.

        Args:
            measured: The measured state.
            now: The time [s].
            adopt: Whether rest in the measured position is commanded from now on. Otherwise the robot must be back at
                the commanded one, to the guard's distance of a start.

        Returns:
            The commanded position, shape (dof,).

        Raises:
            DriverError: The robot moves, or is not back.
        """
        speed = np.abs(measured.velocities)
        if now < self.end or not (speed <= STILL).all():
            k = int(np.argmax(speed))
            raise DriverError(f"the robot moves, {self.names[k]} at {speed[k]:.3g} rad/s, expected rest")
        if adopt:
            self._starts, self._motions = [now], [self._still(measured.positions)]
        elif self._bounds is not None:
            off = np.abs(measured.positions - self.states(np.array([now]))[0, 0])
            if not (off <= self._bounds.start).all():
                k = int(np.argmax(off / self._bounds.start))
                most = f"expected at most {self._bounds.start[k]:g}"
                raise DriverError(f"{self.names[k]} is still {off[k]:.3g} off its commanded position, {most}")
        self.fault = ""
        found: Array = self.states(np.array([now]))[0, 0]
        return found

    def forget(self, now: float) -> None:
        """Drop motions that ``states`` is not asked for again: replaced before a time [s], and not just before it."""
        k = max(bisect_right(self._starts, now - SETTLING) - 1, 0)
        del self._starts[:k], self._motions[:k]

    def _still(self, position: Array) -> Trajectory:
        position, still = finite_array(position, "position"), np.zeros((1, len(self.names)))
        check_array(position, (len(self.names),), "position")
        return Trajectory(np.zeros(1), position[None], still, still, self.names)

    def _check(self, motion: Trajectory) -> None:
        """Check a motion by itself: joints, finite numbers, limits, rest at the end."""
        if motion.joint_names != self.names:
            raise ParameterError("motion", ", ".join(motion.joint_names), f"the joints {', '.join(self.names)}")
        for name in ("positions", "velocities", "accelerations"):
            finite_array(getattr(motion, name), f"motion: {name}")
        for name, share in motion.use(self.limits).items():
            if not share <= 1.0 + LIMIT_ROOM:
                raise ParameterError("motion", f"{share:.4g} of the {name} limit", "a motion within the limits")
        speed, rate = np.abs(motion.velocities[-1]), np.abs(motion.accelerations[-1])
        if (speed > AT_REST).any() or (rate > RATE_SHARE * self.limits.acceleration).any():
            k = int(np.argmax(speed + rate))
            found = f"{speed[k]:.3g} rad/s and {rate[k]:.3g} rad/s^2 of {self.names[k]} at its end"
            raise ParameterError("motion", found, "a motion that ends at rest")

    def _check_start(self, motion: Trajectory, at: float) -> None:
        """Check that a motion starts in the state that is commanded at a time [s]."""
        commanded = self.states(np.array([at]))[:, 0]
        given = np.stack([motion.positions[0], motion.velocities[0], motion.accelerations[0]])
        allowed = np.stack(
            [
                np.full(len(self.names), self.tolerance),
                RATE_SHARE * self.limits.velocity,
                RATE_SHARE * self.limits.acceleration,
            ]
        )
        rates = "position", "velocity", "acceleration"
        for name, off, most in zip(rates, np.abs(given - commanded), allowed, strict=True):
            if not (off <= most).all():
                k = int(np.argmax(off / most))
                found = f"a {name} of {self.names[k]} that is {off[k]:.3g} from the commanded one"
                raise ParameterError("motion", found, f"a start within {most[k]:.3g} of it at {at:g} s")

    def _check_measured(self, motion: Trajectory, at: float, measured: DriverState, bounds: Bounds) -> None:
        """Check that a motion starts where the robot is: off by what it is off now, which it carries along.

        A robot that moves, or did just now, may be off as far as it may while it follows a motion.
        """
        stamp = measured.stamp
        commanded, speeds = self.states(np.array([stamp - SETTLING, stamp, max(at, stamp)]))[:2]
        off = np.abs(motion.positions[0] - commanded[2] - (measured.positions - commanded[1]))
        moves = (np.abs(speeds) > AT_REST).any()
        most = np.maximum(bounds.start, bounds.tracking) if moves else bounds.start
        if not (off <= most).all():
            k = int(np.argmax(off / most))
            where = f"{self.names[k]} is {off[k]:.3g} off the start of the motion"
            raise DriverError(f"{where} as measured at {measured.stamp:.3f} s, expected at most {most[k]:g}")
