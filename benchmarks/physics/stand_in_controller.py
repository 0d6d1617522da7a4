"""A joint trajectory controller in a process of its own, by the documented rules of ROS 2's.

A trajectory starts at the stamp of its header, at once where that is 0, and replaces the one before at that time.
Between points the polynomial of fifth degree is followed; after the last one the robot stays. Before the first point it
is that from the state at the start. Joint states are published 200 times a second, and each is written to a file; the
last joint has no velocity there (NaN), as where a robot has no such interface. Where ``control_msgs`` is installed, the
controller offers its action, too: a new goal aborts the one before, and a goal of other joints is rejected.

Usage: python -m benchmarks.physics.stand_in_controller FILE NAME JOINT=POSITION ... [--ros-args ...]
"""

from __future__ import annotations

import json
import math
import sys
import threading
import time
from typing import Any

import numpy as np
import rclpy
import rclpy.utilities
from rclpy.action import ActionServer, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from benchmarks.timing.exported_motions import NANOSECONDS, Points, evaluated, quintics


class Controller:
    """What the controller follows, and from when on."""

    def __init__(self, names: list[str], position: np.ndarray) -> None:
        """Rest at a position, shape (joints,)."""
        self.names, self.lock = names, threading.Lock()
        self.plan = [(0, Points(np.zeros(1, np.int64), np.stack([position, 0 * position, 0 * position])[:, None], ()))]

    def take(self, message: Any, now: int) -> None:
        """Take a message at a time [ns]."""
        start = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec or now
        assert list(message.joint_names) == self.names
        times = [point.time_from_start.sec * NANOSECONDS + point.time_from_start.nanosec for point in message.points]
        states = [np.array([p.positions, p.velocities, p.accelerations]) for p in message.points]
        if times[0] > 0:
            times, states = [0, *times], [self.state(start), *states]
        points = Points(np.array(times, np.int64), np.stack(states, axis=1), tuple(self.names))
        with self.lock:
            self.plan = [*(one for one in self.plan if one[0] < start), (start, points)]

    def state(self, now: int) -> np.ndarray:
        """Return position, velocity and acceleration at a time [ns], shape (3, joints)."""
        with self.lock:
            start, points = [one for one in self.plan if one[0] <= now][-1]
        k = int(np.searchsorted(points.nanoseconds, now - start, side="right")) - 1
        if k == len(points.nanoseconds) - 1:
            return np.concatenate([points.states[:1, -1], np.zeros_like(points.states[1:, -1])])
        c, h = quintics(Points(points.nanoseconds[k : k + 2], points.states[:, k : k + 2], points.joints))
        share = np.array([(now - start - points.nanoseconds[k]) / (points.nanoseconds[k + 1] - points.nanoseconds[k])])
        return np.stack([evaluated(c, h, share, order)[0, 0] for order in range(3)])


def offer_action(node: Any, name: str, controller: Controller) -> bool:
    """Offer ``/NAME/follow_joint_trajectory`` where ``control_msgs`` is installed, and return whether it is."""
    try:
        from control_msgs.action import FollowJointTrajectory
    except ImportError:
        return False
    goals = list[Any]()

    def accept(goal: Any) -> Any:
        known = list(goal.trajectory.joint_names) == controller.names
        return GoalResponse.ACCEPT if known else GoalResponse.REJECT

    def follow(handle: Any) -> Any:
        goals.append(handle)
        clock, trajectory, result = node.get_clock(), handle.request.trajectory, FollowJointTrajectory.Result()
        controller.take(trajectory, clock.now().nanoseconds)
        last, stamp = trajectory.points[-1].time_from_start, trajectory.header.stamp
        end = (stamp.sec + last.sec) * NANOSECONDS + stamp.nanosec + last.nanosec
        while clock.now().nanoseconds < end and goals[-1] is handle:
            time.sleep(0.005)
        handle.succeed() if goals[-1] is handle else handle.abort()
        return result

    group = ReentrantCallbackGroup()
    place = f"/{name}/follow_joint_trajectory"
    ActionServer(node, FollowJointTrajectory, place, follow, goal_callback=accept, callback_group=group)
    return True


def main() -> None:
    """Follow trajectories until the process is killed."""
    path, name, *given = rclpy.utilities.remove_ros_args(sys.argv)[1:]
    pairs = [one.split("=") for one in given]
    controller = Controller([joint for joint, _ in pairs], np.array([float(value) for _, value in pairs]))
    rclpy.init()
    node = rclpy.create_node(f"stand_in_{name}")
    clock = node.get_clock()
    node.create_subscription(
        JointTrajectory, f"/{name}/joint_trajectory", lambda m: controller.take(m, clock.now().nanoseconds), 10
    )
    states = node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)
    executor = MultiThreadedExecutor(4) if offer_action(node, name, controller) else SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    with open(path, "w") as file:  # noqa: PTH123
        while rclpy.ok():
            now = clock.now()
            state = controller.state(now.nanoseconds)
            velocity = [*state[1, :-1].tolist(), math.nan]
            message = JointState(name=controller.names, position=state[0].tolist(), velocity=velocity)
            message.header.stamp = now.to_msg()
            states.publish(message)
            file.write(json.dumps([now.nanoseconds, *state[0].tolist()]) + "\n")
            file.flush()
            time.sleep(0.005)


if __name__ == "__main__":
    main()
