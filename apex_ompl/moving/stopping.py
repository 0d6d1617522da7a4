"""Stops from any state of motion, along the path of a motion or joint by joint, and their prediction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_ompl.kernel import Kernel
from apex_ompl.kernel.moving import LimitArrays, StopSeries, first_unproved_stop, stop_joints, stop_on_path
from apex_ompl.moving.dynamic_obstacles import SHORTEST, DynamicObstacles, curve_of
from apex_ompl.robot.model import Limits
from apex_ompl.timing.trajectory import STOP_DEVIATION, Trajectory
from apex_ompl.types import Array, Flags
from apex_ompl.util.display import fields_line
from apex_ompl.util.validation import check_array, check_number


class Stop(NamedTuple):
    """A motion to rest.

    Attributes:
        trajectory: The motion, from the given state on.
        beyond: How far it passes the position limits of each joint, shape (dof,) [rad; synergies 0..1]. A joint for
            which this is not 0 has no stop within its limits: the state was not in its stoppable set.
        deviation: Largest distance of any joint from the path along which it stops [rad]; infinity where it stops
            joint by joint.
    """

    trajectory: Trajectory
    beyond: Array
    deviation: float

    def __repr__(self) -> str:
        """Return the fields, arrays by their shapes."""
        return fields_line(self)

    @property
    def within_limits(self) -> bool:
        """Whether it keeps the position limits."""
        return not self.beyond.any()


def stop(limits: Limits, joint_names: tuple[str, ...], position: Array, velocity: Array, acceleration: Array) -> Stop:
    """Return the soonest stop from a state, joint by joint.

    It is what Ruckig's velocity interface finds (Berscheid and Kroeger 2021), in closed form:
    :func:`apex_ompl.kernel.moving.stop_joints`. A joint whose soonest stop would pass a position limit brakes for
    longer, so that it keeps the limit, and swings back. The limits of acceleration and jerk are kept; that of velocity
    is kept where this is possible, i.e. where |v + a |a| / (2 J)| is within it.

    Args:
        limits: Limits of the joints.
        joint_names: Their names.
        position: Shape (dof,) [rad; synergies 0..1].
        velocity: Within the limits, shape (dof,) [rad/s].
        acceleration: Within the limits, shape (dof,) [rad/s^2].

    Raises:
        ParameterError: One has another shape, or a number that is not finite.
    """
    for name, values in (("position", position), ("velocity", velocity), ("acceleration", acceleration)):
        check_array(np.asarray(values), (len(limits.velocity),), name, finite=True)
    times, knots, beyond = stop_joints(position, velocity, acceleration, LimitArrays.of(limits))
    return Stop(Trajectory.unchecked(times, knots, joint_names), beyond, np.inf)


def stop_along(motion: Trajectory, time: float, limits: Limits, deviation: float = STOP_DEVIATION) -> Stop:
    """Return the soonest stop along the path of a motion, among profiles of slowing down.

    It starts with the state of the motion at ``time``, exactly, keeps the limits of velocity, acceleration and jerk,
    and is the rest of the motion itself where no profile ends sooner (:func:`apex_ompl.kernel.moving.stop_on_path`).

    Args:
        motion: A motion within the limits that ends at rest.
        time: Time of the motion, from 0 to its end [s].
        limits: Limits of the joints.
        deviation: Largest distance of any joint from the path [rad].

    Raises:
        ParameterError: ``time`` is no finite number.
    """
    check_number(time, "time")
    states, still = np.stack([motion.positions, motion.velocities, motion.accelerations]), np.zeros(motion.dof)
    found = stop_on_path(motion.times, states, time, LimitArrays.of(limits), deviation)
    if found is None:
        return Stop(motion.after(time), still, 0.0)
    times, knots, apart = found
    return Stop(Trajectory.unchecked(times, knots, motion.joint_names), still, apart)


def stops_proved(
    kernel: Kernel, expected: DynamicObstacles, motion: Trajectory, limits: Limits, moments: Array,
    *, clock: float, age: float, growth: tuple[float, float], period: float,
) -> tuple[int, Flags]:  # fmt: skip
    """Return how many of some moments of a motion, from the first on, have a proved stop, and of which kind.

    At a moment, the obstacles were seen some time ago at their predicted places, and their reachable sets have grown
    since. The next period of the motion is proved clear of these sets, and the soonest stop along the motion after it
    (:func:`stop_along`), or else the stop joint by joint (:func:`stop`), which is flagged, shape (N,). Static obstacles
    are not checked: a stop along the motion stays within a millimeter of it.

    Args:
        kernel: The kernel of the robot with its held objects.
        expected: The predicted obstacles; their margins do not count.
        motion: A motion within the limits that ends at rest.
        limits: Limits of stops.
        moments: Times of the motion, shape (N,) [s].
        clock: Time of the obstacles' stamps when the motion is at 0 [s].
        age: How long before a moment they were seen [s].
        growth: Margin of observed places [m], and its growth since the observation [m/s].
        period: Time from a moment to the stop [s].
    """
    series = StopSeries(
        expected.arrays, expected.with_margin(*growth).packed, age, curve_of(motion),
        np.stack([motion.positions, motion.velocities, motion.accelerations]), LimitArrays.of(limits), STOP_DEVIATION,
        moments, period, clock, SHORTEST,
    )  # fmt: skip
    return first_unproved_stop(kernel, series)
