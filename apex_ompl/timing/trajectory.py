"""Trajectories: joint motions over time, of constant jerk between knots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import FileFormatError, ParameterError
from apex_ompl.kernel.moving import LimitArrays, stop_joints, stop_on_path
from apex_ompl.kernel.timing import relative_gap, sample_motion
from apex_ompl.robot.model import Limits
from apex_ompl.timing.files import NANOSECONDS, STATES, SUFFIXES, decode, encode
from apex_ompl.timing.knots import LEAST_SPANS, even_times, is_on_grid, refitted, spaced, union
from apex_ompl.timing.samples import Extremes, Sample
from apex_ompl.timing.smoothness import PULSE_SHARE, Smoothness, spectral_arc_length
from apex_ompl.types import Array
from apex_ompl.util.display import counted, html_table, one_line
from apex_ompl.util.files import path_text, suffix_of, write_atomically
from apex_ompl.util.validation import (
    check_array,
    check_integer,
    check_number,
    check_positive,
    check_times,
    finite_array,
)

ROUNDING = 1e-9  # of the used share of a limit
CONTINUITY_TOLERANCE = 1e-6  # relative error of a knot integrated from the one before; files of ROS round times
MAX_SAMPLES = 10**7
BLOCK = 1000  # samples of a stream that are computed at once
SPEED_SPACING, MAX_SPEED_SAMPLES = 0.001, 2**15  # of the speed profile for the spectral arc length [s]
LEAST_SPACING = 1e-3
"""Least time between knots for a controller [s]."""
LIMIT_ROOM = 9e-4  # share by which a motion with other knots may exceed a limit; 1e-3 with the rounding in files
WINDOWS = (0.1, 0.2, 0.4, 0.8)  # of a motion with other knots, at whose ends it has the same state [s]
NO_RATE = np.array([[1e-6], [1e-4], [1e-1]])  # velocity, acceleration and jerk that count as none [rad/s^k]
RATES = (10, 20, 25, 40, 50, 100, 125, 200, 250, 400, 500, 1000)  # that are offered [Hz]
SAME_STATE = 1e-6  # largest difference of states where motions are joined [rad/s^k]
STOP_DEVIATION = 1e-3  # of a stop from the path [rad]
MERGED_EXCESS = 1e-8  # share over a limit with merged knots, at which no longer windows are tried
PATH_STOP_SHARES = (1.0 - 9e-7, 1.0)  # of the limits, for a stop along a path: motions leave 1e-6, or nothing
JOINT_STOP_SHARES = (1.0, 0.99, 0.97, 0.9)  # of the limits, for a stop joint by joint whose knots are merged


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Motion of all planned joints over time; the jerk is constant between knots.

    Each joint's position is a piecewise cubic polynomial with continuous acceleration. So the largest velocity,
    acceleration and jerk are known exactly, and a controller that interpolates positions, velocities and accelerations
    at the knots by quintic polynomials, as ROS 2's joint_trajectory_controller does, makes the same motion.

    Attributes:
        times: Times of the knots, increasing from 0, shape (K,) [s].
        positions: Positions at the knots, shape (K, dof) [rad; synergies 0..1].
        velocities: Velocities at the knots, shape (K, dof) [rad/s].
        accelerations: Accelerations at the knots, shape (K, dof) [rad/s^2].
        joint_names: Names of the columns.
    """

    times: Array
    positions: Array
    velocities: Array
    accelerations: Array
    joint_names: tuple[str, ...]

    def __post_init__(self) -> None:
        """Check shapes and numbers.

        Raises:
            ParameterError: Times that do not increase from 0, another shape, a number that is not finite, a joint given
                twice, or knots that no motion of constant jerk joins.
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
        if relative_gap(self.knots) <= CONTINUITY_TOLERANCE:
            return
        q, v, a, t = self.positions, self.velocities, self.accelerations, np.diff(self.times)[:, None]
        reached = q[:-1] + t * (v[:-1] + t * (2.0 * a[:-1] + a[1:]) / 6.0), v[:-1] + t * (a[:-1] + a[1:]) / 2.0
        for name, integrated, given in zip(STATES, reached, (q[1:], v[1:]), strict=False):
            error = np.abs(integrated - given) / np.maximum(1.0, np.abs(given))
            if error.size and error.max() > CONTINUITY_TOLERANCE:
                k = int(error.max(axis=1).argmax())
                raise ParameterError(name, float(given[k][error[k].argmax()]), f"constant jerk before knot {k + 1}")

    @classmethod
    def unchecked(cls, times: Array, states: Array, joint_names: tuple[str, ...]) -> Trajectory:
        """Return the motion through knots from compiled code, states of shape (3, K, dof), without checks."""
        motion = object.__new__(cls)
        values = times, *states, joint_names
        for name, value in zip(("times", *STATES, "joint_names"), values, strict=True):
            object.__setattr__(motion, name, value)
        return motion

    @property
    def knots(self) -> tuple[Array, Array, Array, Array]:
        """Times, positions, velocities and accelerations, as compiled code takes them."""
        return self.times, self.positions, self.velocities, self.accelerations

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @cached_property
    def jerks(self) -> Array:
        """Jerk between each two knots, shape (K - 1, dof) [rad/s^3]."""
        return np.diff(self.accelerations, axis=0) / np.diff(self.times)[:, None]

    def __repr__(self) -> str:
        """Return the numbers of joints and knots, and the duration."""
        return one_line(
            "Trajectory", counted(self.dof, "joint"), f"{self.duration:.3f} s", counted(len(self.times), "knot")
        )

    def _repr_html_(self) -> str:
        """Return what each joint does as a table for notebooks."""
        most = self._extremes
        columns = self.positions[0], self.positions[-1], most.velocity, most.acceleration, most.jerk
        rows = [
            (name, *(f"{value:.4g}" for value in values))
            for name, *values in zip(self.joint_names, *columns, strict=True)
        ]
        head = (
            "joint", "start [rad]", "end", "largest velocity [rad/s]", "acceleration [rad/s^2]", "jerk [rad/s^3]"
        )  # fmt: skip
        return html_table(f"Motion of {self.duration:.3f} s, {counted(self.dof, 'joint')}", rows, head)

    def __call__(self, time: ArrayLike, order: int = 0) -> Array:
        """Return positions or their derivatives; before 0 and after the end the robot is at rest.

        Args:
            time: One time, or several of shape (N,) [s].
            order: 0 for positions, 1 for velocities, 2 for accelerations, 3 for jerks.

        Returns:
            Shape (dof,), or (N, dof).

        Raises:
            ParameterError: ``order`` is not 0 to 3, or a time is not a finite number.
        """
        check_integer(order, "order", 0, len(STATES))
        given = finite_array(time, "time")
        if given.ndim > 1:
            raise ParameterError("time", given.shape, "one time, or several of shape (N,)")
        rows = sample_motion(self.knots, np.atleast_1d(given), order)
        values: Array = rows[0, 0] if given.ndim == 0 else rows[0]
        return values

    def states(self, times: Array) -> Array:
        """Return positions, velocities and accelerations at finite times, shape (N,) [s], in one, shape (3, N, dof)."""
        return sample_motion(self.knots, times, count=len(STATES))

    def sample(self, spacing: float) -> Sample:
        """Return states at a spacing in time, and at the end.

        Raises:
            ParameterError: ``spacing`` is not a positive number of seconds.
        """
        check_positive(spacing, "spacing", "a positive number of seconds")
        if self.duration / spacing > MAX_SAMPLES:
            raise ParameterError("spacing", spacing, f"at most {MAX_SAMPLES} samples")
        times = np.append(spacing * np.arange(max(0, np.ceil(self.duration / spacing - 1e-9))), self.duration)
        return Sample(times, *self.states(times))

    def stream(self, rate: float = 1000.0) -> Iterator[Sample]:
        """Return the states at the rate of a controller one by one, the end last.

        Args:
            rate: Samples a second [Hz].

        Raises:
            ParameterError: ``rate`` is not a positive number.
        """
        check_positive(rate, "rate", "a positive number of samples a second")
        return self._stream(rate)

    def _stream(self, rate: float) -> Iterator[Sample]:
        count = int(np.ceil(self.duration * rate - 1e-9))
        for begin in range(0, count + 1, BLOCK):
            which = np.arange(begin, min(begin + BLOCK, count + 1))
            times = np.where(which == count, self.duration, which / rate)
            states = self.states(times)
            for k, time in enumerate(times.tolist()):
                yield Sample(time, states[0][k], states[1][k], states[2][k])

    def use(self, limits: Limits) -> dict[str, float]:
        """Return the largest share of each limit that any joint uses at any time, by name of the derivative.

        That is max |x_j(t)| / limit_j; for ``position`` it is 1 at a limit and 0 in the middle between two.

        Raises:
            ParameterError: The limits are those of other joints.
        """
        if len(limits.velocity) != self.dof:
            raise ParameterError("limits", len(limits.velocity), f"those of {self.dof} joints")
        middle, half = (limits.upper + limits.lower) / 2.0, (limits.upper - limits.lower) / 2.0
        low, high, velocity, acceleration, jerk = self._extremes
        return {
            "position": float((np.maximum(high - middle, middle - low) / half).max()),
            "velocity": float((velocity / limits.velocity).max()),
            "acceleration": float((acceleration / limits.acceleration).max()),
            "jerk": float((jerk / limits.jerk).max()),
        }

    @cached_property
    def _extremes(self) -> Extremes:
        return Extremes.of(*self.knots)

    @property
    def jerk(self) -> float:
        """Root mean square over time of the norm of the jerk [rad/s^3]; 0 for a motion without duration."""
        if not self.duration:
            return 0.0
        squares = np.sum(self.jerks**2, axis=1)
        return float(np.sqrt(squares @ np.diff(self.times) / self.duration))

    def smoothness(self, limits: Limits, share: float = PULSE_SHARE) -> Smoothness:
        """Return pulses of the acceleration a second, and the root mean square jerk as a share of the limit, by joint.

        Args:
            limits: Limits of the joints.
            share: Share of the acceleration limit above which there is a pulse.
        """
        return Smoothness.of(self.times, self.accelerations, limits, share)

    @property
    def spectral_arc_length(self) -> float:
        """Spectral arc length of the speed |q'|, nearer to 0 for smoother motions; 0 for one without motion."""
        spacing = max(SPEED_SPACING, self.duration / MAX_SPEED_SAMPLES)
        speed = np.linalg.norm(self.sample(spacing).velocity, axis=1)
        return spectral_arc_length(speed, spacing) if len(speed) > 1 and speed.any() else 0.0

    def slower(self, factor: float) -> Trajectory:
        """Return the same motion in a time that is ``factor`` times as long.

        Raises:
            ParameterError: ``factor`` is not a positive number.
        """
        check_positive(factor, "factor", "a positive number")
        velocities, accelerations = self.velocities / factor, self.accelerations / factor**2
        slow = Trajectory(self.times * factor, self.positions, velocities, accelerations, self.joint_names)
        if "_extremes" in self.__dict__:
            slow.__dict__["_extremes"] = self._extremes.slower(factor)
        return slow

    def merged(self, spacing: float = LEAST_SPACING) -> Trajectory:
        """Return the motion with knots at whole nanoseconds, at least ``spacing`` apart [s]; itself where they are so.

        Of knots that are nearer to each other one is kept, and the accelerations are corrected for it
        (:mod:`apex_ompl.timing.knots`). Both ends are exact. Velocities, accelerations and jerks are larger by less
        than 1e-8 of the largest in most motions, and by some 1e-5 in few. A motion shorter than eight spacings gets
        proportionally nearer knots.

        Raises:
            ParameterError: ``spacing`` is not a positive number, or the motion takes a few nanoseconds only.
        """
        check_positive(spacing, "spacing", "a positive number of seconds")
        gaps = np.diff(self.times)
        if 0.0 < self.duration * NANOSECONDS < 4 * LEAST_SPANS:
            raise ParameterError("duration", self.duration, f"at least {4 * LEAST_SPANS} ns, for four spans of time")
        spacing = min(spacing, self.duration / (2 * LEAST_SPANS))
        if not gaps.size or (gaps.min() >= spacing * (1.0 - 1e-6) and is_on_grid(self.times)):
            return self
        return self._at_knots(spaced(self.times, spacing), self._extremes.rates, MERGED_EXCESS)[0]

    def resampled(self, rate: float, limits: Limits | None = None) -> Trajectory:
        """Return the motion with knots at a rate, and at its end; the jerk is constant between them.

        It is another motion, which has the same state as this one every 0.1 to 0.8 s. In between it is, for motions of
        two Pandas, some 0.1 mrad from it at 100 Hz and 0.01 mrad at 250 Hz; :meth:`deviation` tells. Both ends are
        exact. Velocities, accelerations and jerks are at most 1e-3 over the limits. The end is one to two spacings from
        the knot before it.

        Args:
            rate: Knots a second [Hz].
            limits: Limits of the joints; by default the largest rates of each joint.

        Raises:
            ParameterError: The rate is too low for that; the lowest one that is not is named.
        """
        check_positive(rate, "rate", "a positive number of samples a second")
        if not self.duration:
            return self
        if rate * self.duration > MAX_SAMPLES or rate > 1.0 / LEAST_SPACING:
            raise ParameterError("rate", rate, f"at most {1.0 / LEAST_SPACING:g} Hz")
        bounds = (
            self._extremes.rates if limits is None else np.stack([limits.velocity, limits.acceleration, limits.jerk])
        )
        made, excess = self._at_knots(even_times(self.duration, rate), bounds)
        if excess <= LIMIT_ROOM:
            return made
        for higher in RATES:
            if higher > rate and self._at_knots(even_times(self.duration, higher), bounds)[1] <= LIMIT_ROOM:
                raise ParameterError("rate", rate, f"at least {higher} Hz, at which this motion keeps its limits")
        raise ParameterError("rate", rate, "none: the motion keeps its limits with its own knots only")

    def _at_knots(self, times: Array, bounds: Array, enough: float = LIMIT_ROOM) -> tuple[Trajectory, float]:
        """Return the motion with other knots, and by which share it exceeds bounds of the rates, shape (3, dof).

        Longer windows are tried where that share is over ``enough``.
        """
        states = self.states(times)
        for k in (0, -1):
            states[:, k] = self.positions[k], self.velocities[k], self.accelerations[k]
        best, least = self, np.inf
        for window, largest in product(WINDOWS, (None, bounds[1])):
            made = Trajectory.unchecked(times, refitted(states, times, window, largest), self.joint_names)
            excess = float(((made._extremes.rates - bounds) / np.maximum(bounds, NO_RATE)).max())
            if excess < least:
                best, least = made, excess
            if excess <= enough or (self.duration <= window and largest is not None):
                break
        return best, least

    def deviation(self, other: Trajectory) -> float:
        """Return the largest distance of any joint from another motion of the same joints at the same time [rad].

        Raises:
            ParameterError: The motions are of other joints.
        """
        if self.joint_names != other.joint_names:
            raise ParameterError("other", ", ".join(other.joint_names), f"the joints {', '.join(self.joint_names)}")
        times = union(self.times, other.times)
        low, high, *_ = Extremes.of(times, *(self.states(times) - other.states(times)))
        return float(np.maximum(-low, high).max())

    def selected(self, joints: Sequence[str]) -> Trajectory:
        """Return the motion of some of the joints, in their order.

        Raises:
            ParameterError: No joint, an unknown one, or one given twice.
        """
        known = list(self.joint_names)
        names = [] if isinstance(joints, str) else [str(joint) for joint in joints]
        if not names or len(set(names)) < len(names) or not set(names) <= set(known):
            raise ParameterError("joints", joints, f"some of the joints {', '.join(known)}, each once")
        columns = [known.index(name) for name in names]
        states = np.array([[row[columns] for row in getattr(self, name)] for name in STATES])
        return Trajectory.unchecked(self.times, states, tuple(names))

    def before(self, time: float) -> Trajectory:
        """Return the motion up to a time [s].

        Raises:
            ParameterError: ``time`` is not a finite number.
        """
        end = float(np.clip(finite_array(time, "time"), 0.0, self.duration))
        earlier = self.times < end - 1.0 / NANOSECONDS
        times = np.append(self.times[earlier], end) if earlier.any() else np.zeros(1)
        q, v, a = self.states(times)
        return Trajectory(times, q, v, a, self.joint_names)

    def stop_at(self, time: float, limits: Limits) -> Trajectory:
        """Return the motion up to a time, and then the soonest stop within the limits.

        The stop slows down along the path, at most a millirad from it
        (:func:`apex_ompl.kernel.moving.stop_on_path`); where it cannot, as the motion does not end at rest, each joint
        stops by itself (:func:`apex_ompl.kernel.moving.stop_joints`). Where no stop is sooner than the end of the
        motion, it is the motion itself. :func:`joined` adds a motion that goes on. Where knots are merged, it is nearly
        the motion before ``time``; what replaces a motion under way from a time ``t`` on, and starts in its exact
        state, is ``motion.after(t).stop_at(0.0, limits)``.

        Args:
            time: Time at which the robot starts to slow down [s].
            limits: Limits of the joints, which the motion keeps.

        Raises:
            ParameterError: ``time`` is not within the motion, or the motion is over a limit, or a joint cannot stop
                before its position limit.
        """
        check_number(time, "time", 0.0, self.duration)
        for name, share in self.use(limits).items():
            if share > 1.0 + LIMIT_ROOM:
                raise ParameterError("limits", f"{share:.4g} of the {name} limit is used", "limits the motion keeps")
        if self.velocities[-1].any() or self.accelerations[-1].any():
            return self._joint_stop(time, limits)
        states, bounds = np.stack([self.positions, self.velocities, self.accelerations]), LimitArrays.of(limits)
        for share in PATH_STOP_SHARES:
            found = stop_on_path(self.times, states, time, bounds.scaled(share), STOP_DEVIATION)
            if found is not None:
                stop = Trajectory.unchecked(found[0], found[1], self.joint_names)
                return joined([self.before(time), stop]).merged()
        return self

    def _joint_stop(self, time: float, limits: Limits) -> Trajectory:
        """Return the motion up to a time, and then the soonest stop of each joint by itself."""
        head, made = self.before(time), self
        bounds, now = LimitArrays.of(limits), self.states(np.array([time]))[:, 0]
        for share in JOINT_STOP_SHARES:  # with room for the merging
            times, knots, beyond = stop_joints(now[0], now[1], now[2], bounds.scaled(share))
            if beyond.any():
                break
            made = joined([head, Trajectory.unchecked(times.copy(), knots.copy(), self.joint_names)]).merged()
            if max(made.use(limits).values()) <= 1.0 + LIMIT_ROOM:
                return made
        raise ParameterError("time", time, "one from which each joint can stop within its limits")

    def after(self, time: float) -> Trajectory:
        """Return the rest of the motion from a time on [s].

        Raises:
            ParameterError: ``time`` is not a finite number.
        """
        finite_array(time, "time")
        knots = (self.positions, self.velocities, self.accelerations)
        later = self.times > time + 1e-9
        if not later.any():
            q, v, a = (values[-1:] for values in knots)
            return Trajectory(np.zeros(1), q, v, a, self.joint_names)
        now = self.states(np.array([time], float))
        q, v, a = (np.concatenate([here, values[later]]) for here, values in zip(now, knots, strict=True))
        return Trajectory(np.append(0.0, self.times[later] - time), q, v, a, self.joint_names)

    def saved(
        self, *, rate: float | None = None, joints: Sequence[str] | None = None, limits: Limits | None = None
    ) -> Trajectory:
        """Return the motion that :meth:`save` writes, for proofs.

        It is what a controller makes of the file: polynomials of fifth degree through positions, velocities and
        accelerations of two neighboring knots are of third degree here. Only the numbers in the file are rounded
        (except in ``.npz``), which moves it by less than a nanoradian (:data:`apex_ompl.timing.files.DECIMALS`).

        Args:
            rate: Knots a second (:meth:`resampled`); by default the motion's own (:meth:`merged`) [Hz].
            joints: Joints in their order; by default all.
            limits: Limits of all joints, for :meth:`resampled`.

        Raises:
            ParameterError: The rate is too low for the motion, or the joints are not some of its own.
        """
        motion = self.merged() if rate is None else self.resampled(rate, limits)
        return motion if joints is None else motion.selected(joints)

    def save(
        self, path: str | os.PathLike[str], controllers: Mapping[str, Sequence[str]] | None = None, *,
        rate: float | None = None, joints: Sequence[str] | None = None, limits: Limits | None = None,
    ) -> None:  # fmt: skip
        """Write the motion by the suffix of ``path``; :meth:`load` reads it back.

        ``.npz`` holds the knots; ``.csv`` a row for each, under a header of joint names; ``.traj.yaml`` and
        ``.traj.json`` a ``trajectory_msgs/JointTrajectory`` of ROS 2. All times are whole nanoseconds.

        Args:
            path: The file.
            controllers: Joints by the name of their controller; the file then has one message for each, by name.
            rate: Knots a second, and one at the end; by default the motion's own, at least 1 ms apart [Hz].
            joints: Joints in their order; by default all.
            limits: Limits of all joints that the motion at that rate must keep to 1e-3; by default the largest
                velocities, accelerations and jerks of each joint.

        Raises:
            ParameterError: Another suffix, ``controllers`` that do not name each joint once, unknown ``joints``, or a
                rate that is too low for the motion, with the lowest one that is not.
            MissingFileError: The file cannot be written.
        """
        path = Path(path_text(path))
        suffix = suffix_of(path, SUFFIXES)
        motion = self.saved(rate=rate, joints=joints, limits=limits)
        states = {name: getattr(motion, name) for name in STATES}
        write_atomically(path, encode(suffix, motion.times, states, motion.joint_names, controllers))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Trajectory:
        """Read what :meth:`save` wrote; messages of several controllers become one motion.

        Raises:
            MissingFileError: The file cannot be read.
            FileFormatError: It holds no trajectory.
            ParameterError: It has another suffix.
        """
        path = Path(path_text(path))
        times, states, names = decode(path)
        try:
            return cls(times, states[0], states[1], states[2], names)
        except ParameterError as error:
            raise FileFormatError(str(path), error.name, error.value, f"expected {error.expected}") from error


def joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Return motions one after the other as one; each starts in the last state of the one before it.

    Raises:
        ParameterError: No motion, one of other joints, or one that starts in another state.
    """
    if not len(parts):
        raise ParameterError("parts", parts, "one motion or more")
    for k, (one, following) in enumerate(pairwise(parts), 1):
        if following.joint_names != one.joint_names:
            raise ParameterError(f"parts[{k}]", following, f"a motion of the joints {', '.join(one.joint_names)}")
        apart = max(float(np.abs(getattr(following, name)[0] - getattr(one, name)[-1]).max()) for name in STATES)
        if apart > SAME_STATE * max(1.0, float(np.abs(one.accelerations[-1]).max())):
            raise ParameterError(f"parts[{k}]", f"a start {apart:.3g} away", "a start in the last state before it")
    ends = np.cumsum([0.0, *(part.duration for part in parts)])
    times = [part.times[(k > 0) :] + end for k, (part, end) in enumerate(zip(parts, ends[:-1], strict=True))]
    states = [np.concatenate([getattr(part, name)[(k > 0) :] for k, part in enumerate(parts)]) for name in STATES]
    return Trajectory(np.concatenate(times), states[0], states[1], states[2], parts[0].joint_names)
