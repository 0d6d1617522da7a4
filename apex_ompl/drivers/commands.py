"""The motions that were sent to a driver, and the state that they command at a time."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from apex_ompl.errors import ParameterError
from apex_ompl.robot.model import Limits
from apex_ompl.timing.rests import AT_REST
from apex_ompl.timing.trajectory import LIMIT_ROOM, Trajectory
from apex_ompl.types import Array
from apex_ompl.util.validation import check_array, check_positive, finite_array

START_TOLERANCE = 1e-3
"""Largest distance of the start of a motion from the commanded position [rad; synergies 0..1]."""
RATE_SHARE = 1e-3  # the same of velocity and acceleration, as a share of their limits
CLOCK_ROUNDING = 1e-9  # by which a time may be over [s]


class Commands:
    """Motions by the times at which they start: each replaces the earlier ones from its start on.

    Attributes:
        names: Names of the joints.
        limits: Limits that motions keep.
        tolerance: Largest distance of the start of a motion from the commanded position [rad].
    """

    def __init__(
        self, names: tuple[str, ...], limits: Limits, position: Array, tolerance: float = START_TOLERANCE
    ) -> None:  # fmt: skip
        """Command rest at a position, shape (dof,), from time 0 on.

        Raises:
            ParameterError: The position has another shape or a number that is not finite, or the tolerance is not a
                positive number.
        """
        self.names, self.limits = names, limits
        self.tolerance = tolerance
        check_positive(tolerance, "tolerance")
        position = finite_array(position, "position")
        check_array(position, (len(names),), "position")
        still = np.zeros((1, len(names)))
        self._starts = [0.0]
        self._motions = [Trajectory(np.zeros(1), position[None], still, still, names)]

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

    def send(self, motion: Trajectory, at: float, now: float) -> None:
        """Add a motion (:meth:`apex_ompl.drivers.driver.Driver.send`); the time is ``now`` [s]."""
        at = float(finite_array(at, "at"))
        if at < now - CLOCK_ROUNDING:
            raise ParameterError("at", at, f"a time that is not over, {now:g} s or later")
        self._check(motion)
        self._check_start(motion, at)
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
        rest = motion.stop_at(since, self.limits).after(since)
        self._starts.append(at)
        self._motions.append(rest)
        return rest

    def forget(self, now: float) -> None:
        """Drop motions that were replaced before a time [s], which ``states`` is not asked for again."""
        k = max(bisect_right(self._starts, now) - 1, 0)
        del self._starts[:k], self._motions[:k]

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
