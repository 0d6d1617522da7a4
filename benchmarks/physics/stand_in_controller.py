"""A joint trajectory controller in a process of its own, by the documented rules of ROS 2's.

A trajectory starts at the stamp of its header, at once where that is 0, and replaces the one before at that time.
Between points the polynomial of fifth degree is followed; after the last one the robot stays. Before the first point it
is that from the state at the start. Joint states are published 200 times a second, and each is written to a file.

Usage: python stand_in_controller.py FILE NAME JOINT=POSITION ...
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
import rclpy
from quintic import quintic  # of this folder: the program is run by its file
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

NS = 10**9


class Controller:
    """What the controller follows, and from when on."""

    def __init__(self, names: list[str], position: np.ndarray) -> None:
        """Rest at a position, shape (joints,)."""
        self.names = names
        rest = np.stack([position, 0.0 * position, 0.0 * position])
        self.plan: list[tuple[int, list[tuple[float, np.ndarray]]]] = [(0, [(0.0, rest)])]

    def take(self, message: Any, now: int) -> None:
        """Take a message at a time [ns]."""
        stamp = message.header.stamp.sec * NS + message.header.stamp.nanosec
        start = stamp or now
        assert list(message.joint_names) == self.names
        points = []
        for point in message.points:
            after = point.time_from_start.sec + point.time_from_start.nanosec / NS
            points.append((after, np.array([point.positions, point.velocities, point.accelerations])))
        if points[0][0] > 0.0:
            points.insert(0, (0.0, self.state(start)))
        self.plan = [one for one in self.plan if one[0] < start] + [(start, points)]

    def state(self, now: int) -> np.ndarray:
        """Return position, velocity and acceleration at a time [ns], shape (3, joints)."""
        start, points = [one for one in self.plan if one[0] <= now][-1]
        since = (now - start) / NS
        if since >= points[-1][0]:
            state = points[-1][1].copy()
            state[1:] = 0.0
            return state
        k = max(k for k, (time, _) in enumerate(points) if time <= since)
        (first, before), (last, after) = points[k], points[k + 1]
        c, t = quintic(last - first, before, after), since - first
        powers = np.array(
            [[t**k for k in range(6)], [k * t ** max(k - 1, 0) for k in range(6)],
             [k * (k - 1) * t ** max(k - 2, 0) for k in range(6)]]
        )  # fmt: skip
        return powers @ c


def main() -> None:
    """Follow trajectories until the process is killed."""
    path, name, *given = sys.argv[1:]
    pairs = [one.split("=") for one in given]
    controller = Controller([joint for joint, _ in pairs], np.array([float(value) for _, value in pairs]))
    rclpy.init()
    node = rclpy.create_node(f"stand_in_{name}")
    clock = node.get_clock()
    node.create_subscription(
        JointTrajectory, f"/{name}/joint_trajectory", lambda m: controller.take(m, clock.now().nanoseconds), 10
    )
    states = node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)
    with open(path, "w") as file:  # noqa: PTH123
        while rclpy.ok():
            rclpy.spin_once(node, timeout_sec=0.0)
            now = clock.now()
            state = controller.state(now.nanoseconds)
            message = JointState(name=controller.names, position=state[0].tolist(), velocity=state[1].tolist())
            message.header.stamp = now.to_msg()
            states.publish(message)
            file.write(json.dumps([now.nanoseconds, *state[0].tolist()]) + "\n")
            file.flush()
            time.sleep(0.005)


if __name__ == "__main__":
    main()
