"""A driver over ROS 2: motions go to joint trajectory controllers, and the state comes from their joint states.

Each controller gets its joints of a motion as ``trajectory_msgs/JointTrajectory`` with positions, velocities and
accelerations, whose header says when it starts. A ``joint_trajectory_controller`` follows quintic polynomials
between the points, which are the motion itself, and replaces the trajectory before at that time (parameter
``allow_trajectory_replacement`` where there is one). As the motion starts in the state that is commanded then, there is
nothing for the controller to bridge.
"""

from __future__ import annotations

import atexit
import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.drivers.commands import START_TOLERANCE, Commands
from apex_ompl.drivers.controllers import Controllers
from apex_ompl.drivers.driver import DriverState
from apex_ompl.drivers.guard import Guard
from apex_ompl.drivers.library import rclpy
from apex_ompl.drivers.outlets import ActionOutlet, TopicOutlet
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot.model import Robot
from apex_ompl.timing.files import NANOSECONDS
from apex_ompl.timing.trajectory import Trajectory
from apex_ompl.types import Array
from apex_ompl.util.display import one_line
from apex_ompl.util.validation import check_positive

LEAD = 0.03  # after which a stop starts [s]
TRANSIT = 0.005  # in which a message arrives [s]
SILENCE = 0.5  # age of the state after which the robot counts as silent [s]
STARTED = 10.0  # time to wait for controllers and the first state [s]
SPUN = 0.05  # longest time between two looks at whether to end [s]
KEPT = 1000  # measured positions that are kept
MEMORY = 1.0  # for which commands are kept, to compare measured states with them [s]


class Ros2Driver:
    """A robot behind joint trajectory controllers of ROS 2.

    Its clock is that of its node, from the start of the driver on. Messages are taken in a thread of its own, or by the
    executor of a node that is given.

    Attributes:
        names: Names of the joints.
        limits: Limits of the joints.
        controllers: The controllers.
    """

    def __init__(
        self, robot: Robot, controllers: Mapping[str, Sequence[str]] | str, *, renamed: Mapping[str, str] | None = None,
        states: str = "/joint_states", node: Any = "apex_ompl", lead: float = LEAD, silence: float = SILENCE,
        tolerance: float = START_TOLERANCE, started: float = STARTED, transit: float = TRANSIT, action: bool = False,
        guard: Guard | None = None,
    ) -> None:  # fmt: skip
        """Wait for the controllers and the first joint states, in which the robot is taken to rest.

        Args:
            robot: The robot.
            controllers: The joints that each controller moves, by its name, together all of them; or the name of the
                one that moves them all. Trajectories go to the topic ``/NAME/joint_trajectory``.
            renamed: Names of joints in ROS where they are others, by ours.
            states: Topic of the joint states.
            node: Name of the node; or a node of the caller's (``rclpy.node.Node``), whose clock counts, and which the
                caller spins in another thread and destroys.
            lead: Time after which a stop starts, in which its message arrives [s].
            silence: Age of the state after which :meth:`state` says that the robot is silent [s].
            tolerance: Largest distance of the start of a motion from the commanded position [rad].
            started: Time to wait for controllers and states [s].
            transit: Time in which a message arrives; a motion that starts earlier is refused, since the controller
                would jump to it [s].
            action: Whether motions go as goals of the actions ``/NAME/follow_joint_trajectory``, of which each replaces
                the one before, in place of the topics; what they answer is then an error of :meth:`state`.
            guard: How far the robot may be from its motion.

        Raises:
            MissingFileError: The extra ``ros2`` is not installed, or ``control_msgs`` for actions.
            ParameterError: A joint has no controller, or more than one, or is unknown, or a number is not positive.
            DriverError: A controller or the joint states did not appear, or the robot is outside its limits.
        """
        ros = rclpy()
        for name, value in {"lead": lead, "silence": silence, "started": started, "transit": transit}.items():
            check_positive(value, name)
        self.names, self.limits, self._robot = robot.joint_names, robot.limits, robot
        self.controllers = Controllers(self.names, controllers, renamed)
        self._lead, self._silence, self._transit, self._closed = lead, silence, transit, False
        self._lock, self._arrived = threading.Lock(), threading.Condition()
        self._measured: tuple[int, Array, Array] | None = None
        self._answer = ""
        self._history = deque[tuple[int, Array]](maxlen=KEPT)
        self._seen: dict[str, tuple[int, float, float]] = {}
        atexit.register(self.close)  # a thread that still spins then would crash the process
        try:
            self._own = _OwnNode(ros, node) if isinstance(node, str) else None
            self._node = node if self._own is None else self._own.node
            self._zero = self._node.get_clock().now().nanoseconds
            self._outlets: dict[str, TopicOutlet | ActionOutlet] = {}
            for name in self.controllers.joints:
                self._outlets[name] = (
                    ActionOutlet(self._node, name, self._refused)
                    if action
                    else TopicOutlet(self._node, ros.JointTrajectory, name)
                )
            self._subscription = self._node.create_subscription(
                ros.JointState, states, self._take, ros.qos_profile_sensor_data
            )
            start = self._first_state(states, started)
            self._check_limits(start)
        except BaseException:
            self.close()
            raise
        self._message, self._point, self._ros_time = ros.JointTrajectory, ros.JointTrajectoryPoint, ros.Time
        self._commands = Commands(self.names, self.limits, start, tolerance, (guard or Guard()).bounds(robot))

    def __repr__(self) -> str:
        """Return the controllers, and whether the driver is closed."""
        return one_line("Ros2Driver", ", ".join(self.controllers.joints), "closed" if self._closed else "")

    @property
    def time(self) -> float:
        """Time on the node's clock since the start of the driver [s]."""
        return float(self.times_of(self._node.get_clock().now().nanoseconds))

    def times_of(self, stamps: ArrayLike) -> Array:
        """Return stamps of the node's clock, shape (N,) [ns], as times of the driver [s]."""
        return np.asarray((np.asarray(stamps, np.int64) - self._zero) / NANOSECONDS)

    @property
    def end(self) -> float:
        """Time from which on rest is commanded [s]."""
        return self._commands.end

    def state(self) -> DriverState:
        """Return the last measured state.

        Raises:
            DriverError: It is older than ``silence``, or a controller did not take or follow the last motion.
        """
        self._check_open()
        if self._answer:
            raise DriverError(self._answer)
        return self._fresh_state()

    def send(self, motion: Trajectory, at: float) -> None:
        """Follow a motion from a time on (:meth:`apex_ompl.drivers.driver.Driver.send`)."""
        self._check_open()
        with self._lock:
            now = self.time
            self._commands.send(motion, at, now + self._transit, self._fresh_state())
            self._commands.forget(now - max(MEMORY, self._silence))
            self._answer = ""
            self._publish(motion, at)

    def positions(self, at: float) -> Array:
        """Return the measured positions at a time [s], between measurements on straight lines, shape (dof,).

        Before the first measurement that is kept they are those of it, after the last one those of the last.
        """
        with self._arrived:
            kept = [*self._history]
        stamp = self._zero + round(at * NANOSECONDS)
        k = bisect_right(kept, stamp, key=lambda one: one[0])
        if k in (0, len(kept)):
            return kept[min(k, len(kept) - 1)][1]
        (before, first), (after, second) = kept[k - 1 : k + 1]
        return np.asarray(first + (stamp - before) / (after - before) * (second - first))

    def commanded(self, at: float) -> Array:
        """Return the commanded positions, velocities and accelerations at a time [s], shape (3, dof).

        Times from ``silence`` ago on are known.
        """
        self._check_open()
        with self._lock:
            return self._commands.states(np.array([at]))[:, 0]

    def take_over(self) -> None:
        """Take up motions again where the robot was measured last, as where others moved it.

        Raises:
            DriverError: It is silent, outside its limits, or moves.
        """
        self._check_open()
        with self._lock:
            state = self._fresh_state()
            self._check_limits(state.positions)
            self._commands.recover(state, self.time)

    def stop(self) -> None:
        """Come to rest within the limits, along the motion that is under way; motions that wait are dropped."""
        self._check_open()
        with self._lock:
            self._stop()

    @property
    def fault(self) -> str:
        """Why the driver stopped, in a sentence; else empty."""
        return self._commands.fault

    def recover(self) -> Array:
        """Take up motions again, where the robot is back at the position that the controllers hold.

        Raises:
            DriverError: The robot moves, is silent, or is not back: restart controllers and driver.
        """
        self._check_open()
        with self._lock:
            return self._commands.recover(self._fresh_state(), self.time, adopt=False)

    def close(self) -> None:
        """Leave the robot to the motion that it follows, which ends at rest, and end the node."""
        if self._closed:
            return
        self._closed = True
        atexit.unregister(self.close)
        own = getattr(self, "_own", None)
        if own is not None:
            own.close()
        elif hasattr(self, "_subscription"):
            self._node.destroy_subscription(self._subscription)
            for outlet in self._outlets.values():
                outlet.close()

    def _check_open(self) -> None:
        if self._closed:
            raise ParameterError("driver", "one that was closed", "an open one")

    def _check_limits(self, positions: Array) -> None:
        fault = self._robot.limit_fault(positions)
        if fault:
            raise DriverError(f"the robot is outside its limits: {fault}")

    def _stop(self) -> None:
        """Stop what is under way or waits; at rest nothing is sent, since others may move the robot."""
        now = self.time
        if now < self._commands.end:
            start = now + self._lead
            self._publish(self._commands.stop(start), start)

    def _fresh_state(self) -> DriverState:
        """Return the last measured state where the robot is not silent."""
        state = self._last_state()
        age = self.time - state.stamp
        if age > self._silence:
            raise DriverError(f"there were no joint states for {age:.3g} s")
        return state

    def _last_state(self) -> DriverState:
        with self._arrived:
            assert self._measured is not None
            stamp, positions, velocities = self._measured
        return DriverState((stamp - self._zero) / NANOSECONDS, positions, velocities)

    def _watch(self) -> None:
        """Stop where the state that came last is too far from the commanded one."""
        with self._lock:
            if self._commands.watch(self._last_state()):
                self._stop()

    def _first_state(self, states: str, started: float) -> Array:
        """Wait for all controllers and a state of all joints, and return it, shape (dof,)."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._measured is not None, started)
            measured = self._measured
        if measured is None:
            missing = [name for name in self.controllers.ros_names if name not in self._seen]
            raise DriverError(f"no state of {', '.join(missing)} came on {states} in {started:g} s")
        for outlet in self._outlets.values():
            with self._arrived:
                if not self._arrived.wait_for(partial(getattr, outlet, "heard"), started):
                    raise DriverError(f"no controller listens to {outlet.place}")
        return measured[1]

    def _take(self, message: Any) -> None:
        """Take joint states, of all joints or of some; without a stamp they are of now.

        Of joints that were measured later than others the positions at the time of these count, by the velocities.
        Velocities that are missing or NaN, as those of a broadcaster without that interface, are taken to be 0.
        """
        stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec
        stamp = stamp or self._node.get_clock().now().nanoseconds
        speeds = message.velocity or [0.0] * len(message.name)
        for name, position, velocity in zip(message.name, message.position, speeds, strict=False):
            if np.isfinite(position):
                self._seen[name] = (stamp, position, velocity if np.isfinite(velocity) else 0.0)
        rows = [self._seen.get(name) for name in self.controllers.ros_names]
        with self._arrived:
            if all(row is not None for row in rows):
                stamps, positions, velocities = map(np.array, zip(*(row for row in rows if row), strict=True))
                stamp = int(stamps.min())
                positions -= velocities * (stamps - stamp) / NANOSECONDS
                self._measured = stamp, positions, velocities
                if not self._history or stamp > self._history[-1][0]:
                    self._history.append((stamp, positions))
            self._arrived.notify_all()
        if hasattr(self, "_commands") and self._measured is not None:
            self._watch()

    def _publish(self, motion: Trajectory, at: float) -> None:
        """Send each controller its part of a motion from a time on [s]."""
        start = self._zero + round(at * NANOSECONDS)
        for part in self.controllers.parts(motion):
            message = self._message(joint_names=part.joints)
            message.header.stamp = self._ros_time(nanoseconds=start).to_msg()
            for tick, q, v, a in part.points:
                point = self._point(positions=q, velocities=v, accelerations=a)
                point.time_from_start.sec, point.time_from_start.nanosec = divmod(tick, NANOSECONDS)
                message.points.append(point)
            self._outlets[part.controller].send(message)

    def _refused(self, why: str) -> None:
        """Keep why a controller did not take or follow the last motion."""
        self._answer = why


class _OwnNode:
    """A node in a context of its own, which a thread spins."""

    def __init__(self, ros: Any, name: str) -> None:
        self._closed, self._context = False, ros.Context()
        ros.init(context=self._context)
        try:
            self.node = ros.create_node(name, context=self._context)
            self._executor = ros.SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self.node)
        except BaseException:
            self._context.try_shutdown()
            raise
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._closed:
            self._executor.spin_once(timeout_sec=SPUN)

    def close(self) -> None:
        self._closed = True
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()
