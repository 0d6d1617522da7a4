"""Limits of a motion beyond those of single joints: torques by inverse dynamics, and speeds of tools."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from apex_ompl.collision.mass import held_load
from apex_ompl.errors import RobotError, UnknownNameError
from apex_ompl.kernel.timing import PathRows
from apex_ompl.robot.dynamics import Load, kept_dynamics
from apex_ompl.robot.model import Robot
from apex_ompl.scene.bodies import AttachedObject
from apex_ompl.timing.curve import Polyline
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.arrays import distinct

SHARE = 0.999  # share of a limit that motions are slowed down to, since torques are sampled
SPACING = 0.02  # largest spacing of samples in time [s]
MOST_SAMPLES = 2000  # of a long motion
FINER = 8  # samples for each around the largest
PEAKS, NEAR = 4, 0.98  # most of the largest samples, and share of the largest, around which more are taken
GRAVITY_SHARE = 0.995  # share of a limit above which gravity leaves nothing to move with
PATH_SPACING = 0.2  # of the states of a path at which gravity is computed [rad]
POINTS_PER_ROW = 5  # points of a grid along a curve from one at which torques are computed to the next
Measure = Callable[[Trajectory, Array], Array]  # of a motion at times of shape (N,), shape (N, columns)
TOOL_SPEED, TORQUE = "tool_speed", "torque"


class Largest(NamedTuple):
    """Largest value of a measure along a motion, its column, and the time [s]."""

    value: float
    column: int
    time: float


class MotionLimits:
    """Largest torques of the joints and largest speeds of the tools, for a robot with what it holds.

    Attributes:
        robot: The robot.
        torque: Largest torques or forces, shape (dof,) [Nm, N]; infinite for none.
        tool_speed: Tool -> its largest speed [m/s].
        dynamics: Inverse dynamics, and the speeds of the tools.
    """

    def __init__(
        self, robot: Robot, torque: Array, tool_speed: Mapping[str, float] | float | None = None,
        held: Sequence[AttachedObject] = (), payload: Mapping[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Prepare the dynamics.

        Args:
            robot: The robot.
            torque: Largest torques, shape (dof,) [Nm]; infinite for none.
            tool_speed: Largest speed of each hand, held object or link by name, or of all tools [m/s]. The tools are
                the hands and the held objects, and the last links of a robot without hands.
            held: Held objects; those without a mass count as weightless.
            payload: Hand or link -> mass that it holds beside them, at the grasp point of a hand [kg].

        Raises:
            UnknownNameError: There is no such hand, held object or link.
            RobotError: Torques are limited, and no link has a mass.
        """
        self.robot, self.torque = robot, np.asarray(torque, float)
        self._limited = np.flatnonzero(np.isfinite(self.torque))
        points = {name: (hand.palm, np.asarray(hand.point)) for name, hand in robot.hands.items()}
        loads = [load for load in map(held_load, held) if load is not None]
        for name, mass in (payload or {}).items():
            link, center = _point(robot, name, points, "payload")
            loads.append(Load(link, mass, center, np.zeros((3, 3))))
        if not points:
            points = {link: (link, np.zeros(3)) for link in robot.last_links}
        points |= {one.name: (one.link, one.pose[:3, 3]) for one in held}
        if tool_speed is None or isinstance(tool_speed, Mapping):
            self.tool_speed = dict(tool_speed or {})
        else:
            self.tool_speed = dict.fromkeys(points, tool_speed)
        tools = {name: _point(robot, name, points, "tool") for name in self.tool_speed}
        self.dynamics = kept_dynamics(robot, loads, tools, np.isfinite(self.torque))
        if self._limited.size and not self.dynamics.mass > 0.0:
            raise RobotError(f"no link of {robot.name} has a mass, as limits of torque need")
        self._speed = np.array(list(self.tool_speed.values()))
        self._known: WeakKeyDictionary[Trajectory, dict[str, Largest]] = WeakKeyDictionary()

    def use(self, motion: Trajectory) -> dict[str, float]:
        """Return the largest share of the limits that a motion uses, for ``tool_speed`` and ``torque``.

        These are max |v_k(t)| / v_k and max |tau_j(t)| / tau_j. Limits that are not given have no share.
        """
        return {name: largest.value for name, largest in self._largest_shares(motion).items()}

    def fault(self, motion: Trajectory) -> str:
        """Return which limit a motion exceeds, with the joint or tool and the time, or an empty text."""
        for name, (share, k, time) in self._largest_shares(motion).items():
            if share > 1.0 and name == TORQUE:
                joint, limit = self.robot.joint_names[k], self.torque[k]
                return f"the torque of {joint} is {share:.4g} of its limit of {limit:g} Nm at {time:.3f} s"
            if share > 1.0:
                tool, limit = list(self.tool_speed.items())[k]
                return f"the speed of {tool} is {share:.4g} of its limit of {limit:g} m/s at {time:.3f} s"
        return ""

    def stretch(self, motion: Trajectory) -> float:
        """Return the least factor, 1 or more, by which a motion must be slowed down to keep the limits, or infinity.

        In f times the time, tool speeds are v / f and torques (tau - g) / f^2 + g, where g is the torque of gravity. It
        is infinite where gravity alone exceeds a limit.
        """
        largest = self._largest_shares(motion)
        factor = max(1.0, largest[TOOL_SPEED].value / SHARE) if TOOL_SPEED in largest else 1.0
        if TORQUE in largest and largest[TORQUE].value > SHARE:
            factor = max(factor, math.sqrt(_largest(motion, self._needs).value))
        return factor

    def gravity_fault(self, states: Array) -> str:
        """Return at which state of a path gravity alone exceeds the limit of which joint, or an empty text.

        Args:
            states: States of the path, shape (N, dof), joined by straight lines.
        """
        if not self._limited.size:
            return ""
        line = Polyline.through(states)
        arc = np.linspace(0.0, line.length, math.ceil(line.length / PATH_SPACING) + 1)
        gravity = np.abs(self.dynamics.torques(line.at(arc)))
        row, joint = np.unravel_index(int((gravity / self.torque).argmax()), gravity.shape)
        if gravity[row, joint] <= GRAVITY_SHARE * self.torque[joint]:
            return ""
        needed, joint_name = gravity[row, joint], self.robot.joint_names[joint]
        nearest = int(np.linalg.norm(states - line.at(arc[[row]]), axis=1).argmin())
        return (
            f"gravity alone asks for {needed:.4g} Nm of {joint_name} near state {nearest} of the path, "
            f"and its limit is {self.torque[joint]:g} Nm"
        )

    def rows(self, q: Array, first: Array, second: Array) -> PathRows:
        """Return the limits along a curve q(s), linear in u = d^2s/dt^2 and x = (ds/dt)^2.

        Torques are tau = M q' u + (M q'' + C(q, q') q') x + g (Pham and Pham 2018), computed at every
        ``POINTS_PER_ROW``-th point and linear in between; a tool's speed is |J q'| sqrt(x).

        Args:
            q: Evenly spaced points, shape (n, dof).
            first: Derivatives q' by arc length, shape (n, dof).
            second: Derivatives q'', shape (n, dof) [1/rad].
        """
        n, limited = len(q), self._limited
        chosen = distinct(np.append(np.arange(0, n, POINTS_PER_ROW), n - 1))
        between = np.arange(n)
        found = []
        for values in self.dynamics.along(q[chosen], first[chosen], second[chosen]) if len(limited) else ():
            columns = [np.interp(between, chosen, column) for column in values[:, limited].T]
            found.append(np.stack(columns, axis=1))
        slope, bend, gravity = found or [np.empty((n, 0))] * 3
        most = np.full(n, np.inf)
        if self.tool_speed:
            speeds = self.dynamics.speeds(q[chosen], first[chosen]) / (SHARE * self._speed)
            with np.errstate(divide="ignore"):
                most = np.interp(between, chosen, speeds.max(axis=1)) ** -2.0
        limit = SHARE * self.torque[limited]
        low, high = np.minimum(-limit - gravity, 0.0), np.maximum(limit - gravity, 0.0)
        return PathRows(slope, bend, low, high, most)

    def _largest_shares(self, motion: Trajectory) -> dict[str, Largest]:
        """Return the largest share of each limit along a motion, with its joint or tool; kept as long as the motion."""
        if motion not in self._known:
            shares = {TOOL_SPEED: self._speed_shares} if self.tool_speed else {}
            shares |= {TORQUE: self._torque_shares} if self._limited.size else {}
            self._known[motion] = {name: _largest(motion, share) for name, share in shares.items()}
        return self._known[motion]

    def _speed_shares(self, motion: Trajectory, times: Array) -> Array:
        q, v, _ = motion.states(times)
        return np.asarray(self.dynamics.speeds(q, v) / self._speed)

    def _torque_shares(self, motion: Trajectory, times: Array) -> Array:
        return np.asarray(np.abs(self.dynamics.torques(*motion.states(times))) / self.torque)

    def _needs(self, motion: Trajectory, times: Array) -> Array:
        """Return the least f^2 at which torques (tau - g) / f^2 + g are within the limits, shape (N, dof)."""
        q, v, a = motion.states(times)
        gravity = self.dynamics.torques(q)
        moving, limit = self.dynamics.torques(q, v, a) - gravity, SHARE * self.torque
        room = np.where(moving > 0.0, limit - gravity, limit + gravity)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(np.abs(gravity) >= limit, np.inf, np.abs(moving) / room)


def _point(robot: Robot, name: str, points: Mapping[str, tuple[str, Array]], kind: str) -> tuple[str, Array]:
    """Return the link of a hand, held object or link, and its point in the frame of the link, shape (3,) [m]."""
    if name in points:
        return points[name]
    if name not in robot.link_names:
        raise UnknownNameError(kind, name, (*points, *robot.link_names))
    return name, np.zeros(3)


def _largest(motion: Trajectory, measure: Measure) -> Largest:
    """Return the largest value of a measure along a motion.

    It is sampled at knots, where accelerations have their corners, and in between, then densely around the largest.

    Args:
        motion: The motion.
        measure: Returns the values.
    """
    end = motion.duration
    spacing = max(SPACING, end / MOST_SAMPLES)
    _, first = np.unique((motion.times * FINER / spacing).astype(int), return_index=True)
    knots = np.append(motion.times[first], end)
    steps = np.maximum(np.ceil(np.diff(knots) / spacing), 1.0).astype(int)
    times = np.append(np.repeat(knots[:-1], steps) + _fractions(steps) * np.repeat(np.diff(knots), steps), end)
    values = measure(motion, times)
    largest = values.max(axis=1)
    peaks = np.argsort(largest)[-PEAKS:]
    peaks = peaks[largest[peaks] >= NEAR * largest.max()]
    around = np.arange(-FINER, FINER + 1) * (spacing / FINER)
    fine = distinct(np.clip(times[peaks, None] + around, 0.0, end))
    times, values = np.append(times, fine), np.append(values, measure(motion, fine), axis=0)
    row, column = np.unravel_index(int(values.argmax()), values.shape)
    return Largest(float(values[row, column]), int(column), float(times[row]))


def _fractions(counts: NDArray[np.intp]) -> Array:
    """Return 0, 1/n, ..., (n - 1)/n for each count n, one after the other."""
    return np.concatenate([np.arange(n) / n for n in counts.tolist()])
