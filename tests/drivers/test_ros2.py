"""The driver over ROS 2's middleware, against controllers in processes of their own."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import ROOT, benchmark_script

from apex_ompl.drivers import Ros2Driver
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

pytest.importorskip("rclpy")

ALIKE = 1e-6  # of a sample to the motion [rad]
stand_ins_of = benchmark_script("physics.stand_ins")


@pytest.fixture(scope="module", autouse=True)
def _alone() -> Iterator[None]:
    with benchmark_script("physics.ros2_client").alone():
        yield


@pytest.fixture
def stand_ins(robot: Robot, tmp_path: Path) -> Iterator[Any]:
    found = stand_ins_of.StandIns(robot, tmp_path)
    yield found
    found.close()


def motion_from(robot: Robot, q: Array, *ways: float) -> Trajectory:
    states = [q]
    for k, by in enumerate(ways):
        states.append(states[-1] + by * np.where(np.arange(robot.dof) % 8 == k, 1.0, 0.2))
    path = np.clip(states, robot.limits.lower, robot.limits.upper)
    return time_path(path, robot.limits, robot.joint_names).trajectory


def wait(driver: Ros2Driver, until: float) -> None:
    while driver.time < until:
        time.sleep(0.01)


def test_controllers_follow_motions_and_handovers_in_the_middle(robot: Robot, stand_ins: Any) -> None:
    driver, commanded = stand_ins.driver(), list[tuple[float, Trajectory]]()
    q = robot.home
    for k, by in enumerate((0.3, -0.3, 0.2)):
        motion = motion_from(robot, q, by, 0.5 * by)
        start = driver.time + 0.1
        driver.send(motion, start)
        commanded.append((start, motion))
        half = 0.5 * motion.duration
        wait(driver, start + half - 0.08)
        rest = motion.stop_at(half, robot.limits).after(half)  # in the middle of the motion
        driver.send(rest, start + half)
        commanded.append((start + half, rest))
        wait(driver, driver.end + 0.1)
        q = rest.positions[-1]
        state = driver.state()
        assert np.abs(state.positions - q).max() <= ALIKE and not state.velocities.any(), k
    off, moving = stand_ins_of.differences(stand_ins, driver, commanded)
    assert off.max() <= ALIKE and moving > 30
    driver.close()


def test_a_stop_over_the_network_ends_at_rest(robot: Robot, stand_ins: Any) -> None:
    driver = stand_ins.driver()
    motion = motion_from(robot, robot.home, 0.8)
    start = driver.time + 0.1
    driver.send(motion, start)
    with pytest.raises(ParameterError, match="a time that is not over"):  # the message would come too late
        driver.send(motion, driver.time + 0.001)
    for share in (0.1, 0.2, 0.3):
        wait(driver, start + share * motion.duration)
        state = driver.state()  # of two broadcasters, at one time
        assert np.abs(state.positions - driver.commanded(state.stamp)[0]).max() <= 5e-3
        earlier = state.stamp - 0.02
        assert np.abs(driver.positions(earlier) - driver.commanded(earlier)[0]).max() <= 5e-3
    driver.stop()
    assert driver.end < start + motion.duration
    wait(driver, driver.end + 0.3)
    state = driver.state()
    assert not state.velocities.any()
    line = motion.positions[-1] - motion.positions[0]
    share = (state.positions - motion.positions[0]) @ line / (line @ line)
    assert 0.2 < share < 0.95
    with pytest.raises(ParameterError, match="a time that is not over"):
        driver.send(motion, start)
    driver.close()
    with pytest.raises(ParameterError, match="driver: expected an open one"):
        driver.state()


KILLED = """
import os, sys, time, numpy as np
sys.path.insert(0, {helpers!r}); sys.path.insert(0, {tests!r})
from apex_ompl.drivers import Ros2Driver
from apex_ompl.robot import load_robot
from test_ros2 import motion_from
robot = load_robot("dual_panda_softhand")
joints = {joints!r}
driver = Ros2Driver(robot, joints, renamed={{name: {prefix!r} + name for name in robot.joint_names}}, started=60.0)
motion = motion_from(robot, robot.home, 0.4).slower(3.0)
driver.send(motion, driver.time + 0.1)
while np.abs(driver.state().positions - robot.home).max() < 0.1:
    time.sleep(0.005)
os.kill(os.getpid(), 9)
"""


def test_a_client_that_is_killed_leaves_the_robot_at_rest(robot: Robot, stand_ins: Any) -> None:
    code = KILLED.format(
        helpers=str(ROOT / "tests" / "helpers"), tests=str(ROOT / "tests" / "drivers"), joints=stand_ins.joints,
        prefix=stand_ins_of.PREFIX,
    )  # fmt: skip
    killed = subprocess.run([sys.executable, "-c", code], check=False, timeout=120)
    assert killed.returncode == -signal.SIGKILL
    motion = motion_from(robot, robot.home, 0.4).slower(3.0)
    until, off = time.monotonic() + motion.duration + 20.0, np.inf
    while off > ALIKE and time.monotonic() < until:  # a busy machine is late
        time.sleep(0.5)
        times, states = stand_ins.followed()
        late = times > times.max() - 3 * 10**8
        off = float(np.nanmax(np.abs(states[late] - motion.positions[-1]))) if late.sum() > 5 else np.inf
    assert off <= ALIKE


def test_robots_that_do_not_answer_are_named(robot: Robot) -> None:
    with pytest.raises(DriverError, match="no state of left_joint1, .* came on /joint_states in 0.3 s"):
        Ros2Driver(robot, "arms", started=0.3)
    with pytest.raises(ParameterError, match="controllers: expected each joint of the trajectory once"):
        Ros2Driver(robot, {"arms": robot.joint_names[:3]})
    with pytest.raises(ParameterError, match="renamed: expected joints of"):
        Ros2Driver(robot, "arms", renamed={"elbow": "e"})
    with pytest.raises(ParameterError, match="lead"):
        Ros2Driver(robot, "arms", lead=-1.0)


def test_a_robot_that_falls_silent_is_noticed(robot: Robot, stand_ins: Any) -> None:
    driver = stand_ins.driver(silence=1.0)
    assert driver.state().stamp <= driver.time
    for process in stand_ins.processes:
        process.send_signal(signal.SIGSTOP)
    wait(driver, driver.time + 1.5)
    with pytest.raises(DriverError, match="no joint states for"):
        driver.state()
    driver.close()
