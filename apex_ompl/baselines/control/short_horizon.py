"""Motions over a short horizon: the steps of a control as a spline in time that ends at rest.

The states of the steps are the control points P_k of a uniform cubic B-spline in time with knots one step h apart.
Its velocities are averages of the speeds (P_k+1 - P_k) / h, its accelerations averages of their changes over h, and its
jerks changes of these over h. So a rollout whose speeds and accelerations keep the limits is a motion that keeps them,
too; the acceleration is at most half the jerk limit times h, so that jerks keep theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from apex_ompl.moving.motion_optimizer import shortest_duration
from apex_ompl.moving.search import Search
from apex_ompl.robot.model import Limits
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.timing.spline_method import least_knot_spacing, start_points
from apex_ompl.timing.timed_spline import Start, TimedSpline
from apex_ompl.types import Array

Control = Callable[[int, Array, Array], Array]
STRAIGHT = 32  # states of a straight motion
STRETCHES, SLOWER = 12, 1.05  # changes of the duration of a straight motion that starts while moving, and their least


@dataclass(frozen=True, eq=False)
class Horizon:
    """Steps of a control, each a change of speed, clipped to the limits.

    Attributes:
        limits: Limits of the joints.
        step: Time between two states [s].
    """

    limits: Limits
    step: float = 0.05

    @cached_property
    def most(self) -> Array:
        """Largest acceleration, shape (dof,) [rad/s^2]."""
        return np.minimum(self.limits.acceleration, 0.5 * self.limits.jerk * self.step)

    def roll(self, start: Start, controls: Array) -> Array:
        """Return the states that controls lead to, shape (K, N, dof) [rad/s^2], of N rollouts; see :meth:`steer`."""
        return self.steer(start, controls.shape[:2], lambda k, speed, at: controls[k])

    def steer(self, start: Start, shape: tuple[int, int], control: Control) -> Array:
        """Return the states that a control leads to, at rest in the end.

        Args:
            start: State in which the motion starts.
            shape: Number K of steps, and number N of rollouts.
            control: Returns the wanted accelerations at a step, shape (N, dof) [rad/s^2], from its number, the speeds,
                and the states.

        Returns:
            Control points, shape (K + 3, N, dof) [rad]: the first three fix the start of the motion; number k is near
            the state at time (k - 1) h. The last two are the same.
        """
        count, rollouts = shape
        points = np.empty((count + 3, rollouts, len(start.position)))
        points[:3] = start_points(start, self.step)[:, None]
        bounds = self._range(start)
        for k in range(count):
            speed, at = (points[k + 2] - points[k + 1]) / self.step, points[k + 2]
            wanted = self._keeping(speed + self.step * control(k, speed, at), at, count - 1 - k)
            low, high = bounds if k == 0 else (-self.most, self.most)
            points[k + 3] = at + self.step * np.clip(wanted, speed + self.step * low, speed + self.step * high)
        points[-1] = points[-2]  # they are the same except for rounding
        return points

    def applied(self, points: Array) -> Array:
        """Return the accelerations of rollouts, shape (K, N, dof), from their control points."""
        speeds = np.diff(points[1:], axis=0) / self.step
        changes: Array = np.diff(speeds, axis=0) / self.step
        return changes

    def motion(self, start: Start, points: Array, names: tuple[str, ...]) -> Trajectory:
        """Return the motion of one rollout, from its control points, shape (K + 3, dof)."""
        control = np.concatenate([points, points[-1:]])
        return TimedSpline(control, self.step, start).trajectory(names)

    def _keeping(self, wanted: Array, at: Array, left: int) -> Array:
        """Return speeds from which the robot can stop within ``left`` steps, and within the limits of its position."""
        limits = self.limits
        fastest = np.minimum(limits.velocity, self.most * self.step * left)
        below = np.minimum(wanted, np.minimum(fastest, self._stoppable(limits.upper - at)))
        kept: Array = np.maximum(below, -np.minimum(fastest, self._stoppable(at - limits.lower)))
        return kept

    def _range(self, start: Start) -> tuple[Array, Array]:
        """Return the least and the largest acceleration of the first step, by the jerk."""
        change = self.limits.jerk * self.step
        low = np.clip(start.acceleration - change, -self.most, self.most)
        high = np.clip(start.acceleration + change, -self.most, self.most)
        return low, high

    def _stoppable(self, room: Array) -> Array:
        """Return the largest speed of the next step from which a stop keeps within the room to a limit [rad/s].

        With speed d, acceleration a and steps h a stop takes at most d^2 / 2a + d h / 2 + a h^2 / 8.
        """
        speed = self.most * (np.sqrt(2.0 * np.maximum(room, 0.0) / self.most) - 0.5 * self.step)
        return np.asarray(np.maximum(speed, 0.0))


def first_proved(search: Search, horizon: Horizon, controls: Array, counts: tuple[int, ...]) -> Trajectory | None:
    """Return the motion by the first controls and a stop, for the first number of controls that is proved, or None.

    Args:
        search: The replan.
        horizon: The steps.
        controls: Accelerations, shape (K, dof) [rad/s^2].
        counts: Numbers of steps that are tried, including the stop.
    """
    for count in counts:
        points = horizon.roll(search.start, controls[:count, None])[:, 0]
        motion = horizon.motion(search.start, points, search.context.names)
        search.budget.spend("short motion")
        if search.accepts(motion):
            return motion
    return None


def finish(search: Search, near: float) -> Trajectory | None:
    """Return the straight motion to a goal that is at most ``near`` away in any joint [rad], if it is proved."""
    for goal in search.goals:
        if np.abs(goal - search.start.position).max() <= near:
            motion = straight(search, goal)
            if motion is not None and search.accepts(motion):
                return motion
    return None


def straight(search: Search, goal: Array) -> Trajectory | None:
    """Return the straight motion to a state, or None where there is none within the limits from a moving start."""
    start, limits, names = search.start, search.context.limits, search.context.names
    search.budget.spend("straight motion")
    if not (start.velocity.any() or start.acceleration.any()):
        ends = np.stack([start.position, goal])
        return time_path(ends, limits, names, motion_limits=search.context.torques).trajectory
    return _stretched(search, np.linspace(start.position, goal, STRAIGHT), goal)


def along(search: Search, states: Array, goal: Array) -> Trajectory | None:
    """Return the motion whose spline has some states as control points and ends in one, or None within the limits.

    Args:
        search: The replan, with the state in which the motion starts.
        states: States of the motion, evenly spaced in time, shape (N, dof).
        goal: Where it ends, shape (dof,).
    """
    search.budget.spend("straight motion")
    return _stretched(search, states, goal)


def _stretched(search: Search, states: Array, goal: Array) -> Trajectory | None:
    """Return the spline along states with the duration that the limits require, or None where it is not found."""
    limits = search.context.limits
    spline = TimedSpline.along(states, shortest_duration(states, limits), search.start, goal)
    for _ in range(STRETCHES):
        least = least_knot_spacing(spline.control, limits)
        if least <= spline.spacing:
            return spline.trajectory(search.context.names)
        spline = spline.lasting(max(least, SLOWER * spline.spacing))
    return None
