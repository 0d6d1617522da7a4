"""The guard over ROS 2's middleware: a robot that does not follow, or is pushed, in another node."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from apex_ompl.drivers import Guard, Ros2Driver
from apex_ompl.errors import DriverError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path

rclpy = pytest.importorskip("rclpy")


class StuckRobot:
    """A robot that stays where it is put, and keeps the trajectories that it gets."""

    def __init__(self, robot: Robot) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
        from trajectory_msgs.msg import JointTrajectory

        self.names, self.at = list(robot.joint_names), robot.home.copy()
        self.messages: list[Any] = []
        self._ended = False
        self._kind = JointState
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("stuck_robot", context=self._context)
        self._node.create_subscription(JointTrajectory, "/arms/joint_trajectory", self.messages.append, 10)
        self._publisher = self._node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)
        self._node.create_timer(0.01, self._publish)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ended:
            self._executor.spin_once(timeout_sec=0.05)

    def _publish(self) -> None:
        message = self._kind(name=self.names, position=self.at.tolist(), velocity=[0.0] * len(self.names))
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)

    def close(self) -> None:
        self._ended = True
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def stuck(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> Iterator[StuckRobot]:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + (os.getpid() + 50) % 100))
    found = StuckRobot(robot)
    yield found
    found.close()


def motion_of(robot: Robot, by: float) -> Trajectory:
    goal = robot.home + by * (np.arange(robot.dof) == 0)
    return time_path(np.stack([robot.home, goal]), robot.limits, robot.joint_names).trajectory


def wait(found: Any, most: float = 5.0) -> None:
    end = time.monotonic() + most
    while not found() and time.monotonic() < end:
        time.sleep(0.01)
    assert found()


def test_a_robot_that_does_not_follow_is_stopped(robot: Robot, stuck: StuckRobot) -> None:
    driver = Ros2Driver(robot, "arms", started=20.0, silence=10.0)
    motion = motion_of(robot, 1.0)
    start = driver.time + 0.2
    driver.send(motion, start)
    wait(lambda: driver.fault)
    assert "left_joint1 was 0.0" in driver.fault and driver.end < start + motion.duration
    with pytest.raises(DriverError, match="the robot was stopped, since left_joint1 was"):
        driver.send(motion, driver.time + 1.0)
    wait(lambda: len(stuck.messages) == 2)
    stop = stuck.messages[1]
    last = stop.points[-1]
    assert np.abs(last.velocities).max() < 1e-12 and np.abs(last.accelerations).max() < 1e-9
    since = stop.header.stamp.sec + stop.header.stamp.nanosec / 1e9
    since -= stuck.messages[0].header.stamp.sec + stuck.messages[0].header.stamp.nanosec / 1e9
    assert 0.0 < since < motion.duration  # from the state that is commanded then
    np.testing.assert_allclose(stop.points[0].positions, motion(since), atol=1e-6)
    np.testing.assert_allclose(last.positions, motion.stop_at(since, robot.limits).positions[-1], atol=1e-5)
    wait(lambda: driver.time > driver.end)
    with pytest.raises(DriverError, match="left_joint1 is still 0.* off its commanded position"):
        driver.recover()
    stuck.at = np.array(last.positions)
    wait(lambda: np.abs(driver.state().positions - stuck.at).max() < 1e-9)
    driver.recover()
    assert not driver.fault
    driver.close()


def test_a_start_off_the_measured_position_is_refused(robot: Robot, stuck: StuckRobot) -> None:
    driver = Ros2Driver(robot, "arms", started=20.0, silence=10.0, guard=Guard(start=0.005))
    stuck.at = robot.home + 0.02 * (np.arange(robot.dof) == 2)
    wait(lambda: np.abs(driver.state().positions - stuck.at).max() < 1e-9)
    with pytest.raises(DriverError, match=r"left_joint3 is 0\.02 off the start of the motion"):
        driver.send(motion_of(robot, 0.3), driver.time + 0.2)
    driver.close()
    assert not stuck.messages


def test_at_rest_others_may_move_the_robot(robot: Robot, stuck: StuckRobot) -> None:
    driver = Ros2Driver(robot, "arms", started=20.0, silence=10.0)
    stuck.at = robot.home + 0.2 * (np.arange(robot.dof) == 0)
    wait(lambda: driver.fault)
    driver.stop()
    with pytest.raises(DriverError, match="the robot was stopped, since left_joint1 was 0.2 off"):
        driver.send(motion_of(robot, 0.3), driver.time + 0.2)
    wait(lambda: np.abs(driver.state().positions - stuck.at).max() < 1e-9)
    driver.take_over()
    assert not driver.fault
    time.sleep(0.1)  # for messages to come, if there were any
    assert not stuck.messages  # which would pull the robot back
    goal = stuck.at + 0.3 * (np.arange(robot.dof) == 0)
    motion = time_path(np.stack([stuck.at, goal]), robot.limits, robot.joint_names).trajectory
    driver.send(motion, driver.time + 0.2)
    wait(lambda: stuck.messages)
    driver.close()
