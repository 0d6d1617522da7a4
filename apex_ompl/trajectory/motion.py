"""Motions over time, of constant jerk between knots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.robot.model import Limits
from apex_ompl.trajectory.files import STATES, SUFFIXES, decoded, encoded
from apex_ompl.trajectory.smoothness import spectral_arc_length
from apex_ompl.types import Array
from apex_ompl.util.files import suffix_of, write_atomically
from apex_ompl.util.validation import check_array, check_integer, check_positive, check_times, finite_array

ROUNDING = 1e-9  # of shares of limits
JOINED = 1e-6  # share by which a knot may be off what the one before it leads to; files of ROS round times
MOST_SAMPLES = 10**7
BLOCK = 1000  # moments of a stream that are made at once
FINE, MOST = 0.001, 2**15  # samples of the speed [s], and how many at most


class Sample(NamedTuple):
    """A motion at one moment, or at several.

    Attributes:
        time: [s].
        position: Shape (..., dof) [rad; synergies 0..1].
        velocity: [rad/s].
        acceleration: [rad/s^2].
    """

    time: float | Array
    position: Array
    velocity: Array
    acceleration: Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion of all planned joints over time; the jerk is constant between knots.

    Each joint's position is a piecewise cubic function with continuous acceleration, so that its greatest velocity,
    acceleration and jerk are known exactly, and so that a controller which interpolates positions, velocities and
    accelerations at the knots by quintic polynomials, as ROS 2's joint_trajectory_controller does, makes the same
    motion.

    Attributes:
        times: Of the knots, rising from 0, shape (K,) [s].
        positions: At the knots, shape (K, dof) [rad; synergies 0..1].
        velocities: Shape (K, dof) [rad/s].
        accelerations: Shape (K, dof) [rad/s^2].
        joint_names: Of the columns.
    """

    times: Array
    positions: Array
    velocities: Array
    accelerations: Array
    joint_names: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises:
            ParameterError: Times that do not rise from 0, another shape, a number that is none, a joint given twice, or
                knots that no motion of constant jerk joins.
        """
        for name in ("times", *STATES):
            object.__setattr__(self, name, finite_array(getattr(self, name), name))
        names = tuple(self.joint_names)
        object.__setattr__(self, "joint_names", names)
        if not names or len(set(names)) < len(names):
            raise ParameterError("joint_names", names, "one name or more, each once")
        check_times(self.times)
        for name in STATES:
            check_array(getattr(self, name), (len(self.times), len(names)), name)
        q, v, a, t = self.positions, self.velocities, self.accelerations, np.diff(self.times)[:, None]
        reached = q[:-1] + t * (v[:-1] + t * (2.0 * a[:-1] + a[1:]) / 6.0), v[:-1] + t * (a[:-1] + a[1:]) / 2.0
        for name, there, wanted in zip(STATES, reached, (q[1:], v[1:]), strict=False):
            apart = np.abs(there - wanted) / np.maximum(1.0, np.abs(wanted))
            if apart.size and apart.max() > JOINED:
                k = int(apart.max(axis=1).argmax())
                raise ParameterError(name, float(wanted[k][apart[k].argmax()]), f"constant jerk before knot {k + 1}")

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return float(self.times[-1])

    @property
    def dof(self) -> int:
        """How many joints move."""
        return len(self.joint_names)

    @cached_property
    def jerks(self) -> Array:
        """The jerk between each two knots, shape (K - 1, dof) [rad/s^3]."""
        return np.diff(self.accelerations, axis=0) / np.diff(self.times)[:, None]

    def __call__(self, time: ArrayLike, order: int = 0) -> Array:
        """Return positions or derivatives at moments; before 0 and after the end the robot stands still.

        Args:
            time: A moment, or several of shape (N,) [s].
            order: 0 for positions, 1 for velocities, 2 for accelerations, 3 for jerks.

        Returns:
            Shape (dof,), or (N, dof).

        Raises:
            ParameterError: ``order`` is none of these, or a time is no number.
        """
        check_integer(order, "order", 0, len(STATES))
        given = finite_array(time, "time")
        if given.ndim > 1:
            raise ParameterError("time", given.shape, "one moment, or several of shape (N,)")
        moments = np.atleast_1d(given)
        if len(self.times) == 1:
            found = np.repeat(self.positions if order == 0 else np.zeros((1, self.dof)), len(moments), axis=0)
        else:
            piece = np.clip(np.searchsorted(self.times, moments, side="right") - 1, 0, len(self.times) - 2)
            since = np.clip(moments, 0.0, self.duration)[:, None] - self.times[piece, None]
            q, v, a, j = self.positions[piece], self.velocities[piece], self.accelerations[piece], self.jerks[piece]
            found = (
                q + since * (v + since * (a / 2.0 + since * j / 6.0)),
                v + since * (a + since * j / 2.0),
                a + since * j,
                j,
            )[order]
            if order < len(STATES):  # without rounding at the end
                found[moments >= self.duration] = (self.positions, self.velocities, self.accelerations)[order][-1]
            if order > 0:
                found[(moments < 0.0) | (moments > self.duration)] = 0.0
        return found[0] if given.ndim == 0 else found

    def sample(self, spacing: float) -> Sample:
        """Return the motion at even times and at its end.

        Raises:
            ParameterError: ``spacing`` is not a positive number of seconds.
        """
        check_positive(spacing, "spacing", "a positive number of seconds")
        if self.duration / spacing > MOST_SAMPLES:
            raise ParameterError("spacing", spacing, f"at most {MOST_SAMPLES} samples")
        count = max(0, int(np.ceil(self.duration / spacing - 1e-9)))
        times = np.append(spacing * np.arange(count), self.duration)
        return Sample(times, self(times), self(times, 1), self(times, 2))

    def stream(self, rate: float = 1000.0) -> Iterator[Sample]:
        """Return the motion moment by moment, as a controller wants it, its end last.

        Args:
            rate: Moments a second [Hz].

        Raises:
            ParameterError: ``rate`` is not a positive number.
        """
        check_positive(rate, "rate", "a positive number of moments a second")
        return self._stream(rate)

    def _stream(self, rate: float) -> Iterator[Sample]:
        count = int(np.ceil(self.duration * rate - 1e-9))
        for begin in range(0, count + 1, BLOCK):
            which = np.arange(begin, min(begin + BLOCK, count + 1))
            times = np.where(which == count, self.duration, which / rate)
            states = self(times), self(times, 1), self(times, 2)
            for k, time in enumerate(times.tolist()):
                yield Sample(time, states[0][k], states[1][k], states[2][k])

    def use(self, limits: Limits) -> dict[str, float]:
        """Return the largest share of each limit that is used at any moment by any joint, by name of the derivative.

        That of ``position`` is 1 at a limit and 0 in the middle between two.

        Raises:
            ParameterError: The limits are those of other joints.
        """
        if len(limits.velocity) != self.dof:
            raise ParameterError("limits", len(limits.velocity), f"those of {self.dof} joints")
        middle, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
        jerk = np.abs(self.jerks / limits.jerk).max(initial=0.0)
        return {
            "position": float(np.abs((self._turns(0) - middle) / half).max()),
            "velocity": float(np.abs(self._turns(1) / limits.velocity).max()),
            "acceleration": float(np.abs(self.accelerations / limits.acceleration).max()),
            "jerk": float(jerk),
        }

    def _turns(self, order: int) -> Array:
        """Return positions or velocities at knots and where they turn in between, shape (n, dof)."""
        v, a, j = self.velocities[:-1], self.accelerations[:-1], self.jerks
        length = np.diff(self.times)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            if order == 1:
                roots = [-a / j]
            else:
                side = np.sqrt(a * a - 2.0 * j * v)
                roots = [(-a + side) / j, (-a - side) / j, -v / a]
        found = [self.positions if order == 0 else self.velocities]
        for root in roots:
            since = np.clip(np.nan_to_num(root, nan=0.0, posinf=0.0, neginf=0.0), 0.0, length)
            if order == 1:
                found.append(v + since * (a + since * j / 2.0))
            else:
                found.append(self.positions[:-1] + since * (v + since * (a / 2.0 + since * j / 6.0)))
        return np.concatenate(found)

    @property
    def jerk(self) -> float:
        """The root mean square of the jerk over time, of all joints together [rad/s^3]; 0 of a motion without time."""
        if not self.duration:
            return 0.0
        squares = np.sum(self.jerks**2, axis=1)
        return float(np.sqrt(squares @ np.diff(self.times) / self.duration))

    @property
    def spectral_arc_length(self) -> float:
        """The spectral arc length of the joints' common speed, nearer to 0 for smoother motions; 0 without motion."""
        spacing = max(FINE, self.duration / MOST)
        speed = np.linalg.norm(self.sample(spacing).velocity, axis=1)
        return spectral_arc_length(speed, spacing) if len(speed) > 1 and speed.any() else 0.0

    def slower(self, factor: float) -> Trajectory:
        """Return the same motion in a time that is ``factor`` times as long.

        Raises:
            ParameterError: ``factor`` is not a positive number.
        """
        check_positive(factor, "factor", "a positive number")
        return Trajectory(
            self.times * factor, self.positions, self.velocities / factor, self.accelerations / factor**2,
            self.joint_names,
        )  # fmt: skip

    def after(self, time: float) -> Trajectory:
        """Return what is left of the motion after a moment [s].

        Raises:
            ParameterError: ``time`` is no number.
        """
        finite_array(time, "time")
        later = self.times > time + 1e-9
        if not later.any():
            return Trajectory(
                np.zeros(1), self.positions[-1:], self.velocities[-1:], self.accelerations[-1:], self.joint_names
            )
        head = [self(time, order)[None] for order in range(3)]
        rest = (self.positions, self.velocities, self.accelerations)
        parts = [np.concatenate([first, more[later]]) for first, more in zip(head, rest, strict=True)]
        times = np.append(0.0, self.times[later] - time)
        return Trajectory(times, parts[0], parts[1], parts[2], self.joint_names)

    def save(self, path: str | os.PathLike[str], controllers: Mapping[str, Sequence[str]] | None = None) -> None:
        """Write the motion by the suffix of ``path``; :meth:`load` reads it back.

        ``.npz`` holds the knots; ``.csv`` a line for each, with joint names in the head; ``.traj.yaml`` and
        ``.traj.json`` a ``trajectory_msgs/JointTrajectory`` of ROS 2, whose times are whole nanoseconds.

        Args:
            path: The file.
            controllers: Joints by the name of their controller; then the file has one message for each, by name.

        Raises:
            ParameterError: Another suffix, or ``controllers`` that do not have each joint once.
            MissingFileError: The file cannot be written.
        """
        path = Path(path)
        states = {name: getattr(self, name) for name in STATES}
        write_atomically(path, encoded(suffix_of(path, SUFFIXES), self.times, states, self.joint_names, controllers))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read what :meth:`save` wrote, messages of several controllers as one motion.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It holds no trajectory.
            ParameterError: It has another suffix.
        """
        path = Path(path)
        times, states, names = decoded(path)
        try:
            return cls(times, states[0], states[1], states[2], names)
        except ParameterError as error:
            raise FileFormatError(str(path), error.name, error.value, f"expected {error.expected}") from error


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return motions one behind the other; each begins as the one before it ends."""
    ends = np.cumsum([0.0, *(part.duration for part in parts)])
    times = [part.times[(k > 0) :] + end for k, (part, end) in enumerate(zip(parts, ends[:-1], strict=True))]
    states = [np.concatenate([getattr(part, name)[(k > 0) :] for k, part in enumerate(parts)]) for name in STATES]
    return Trajectory(np.concatenate(times), states[0], states[1], states[2], parts[0].joint_names)
