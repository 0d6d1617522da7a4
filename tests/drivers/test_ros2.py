"""The driver over ROS 2's middleware, against controllers in processes of their own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support import ROOT

from apex_ompl.drivers import Ros2Driver
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

pytest.importorskip("rclpy")

ALIKE = 1e-6  # of a sample to the motion [rad]
STAND_IN = ROOT / "tests" / "helpers" / "stand_in_controller.py"
PREFIX = "r_"  # of joints in ROS


class StandIns:
    """Controllers of the left arm with hand, and of the right one."""

    def __init__(self, robot: Robot, folder: Path) -> None:
        left = [name for name in robot.joint_names if name.startswith("left")]
        self.joints = {"left": left, "right": [name for name in robot.joint_names if name not in left]}
        self.robot, self.folder = robot, folder
        self.processes = []
        for name, joints in self.joints.items():
            at = [f"{PREFIX}{joint}={float(robot.home[robot.joint_names.index(joint)])!r}" for joint in joints]
            command = [sys.executable, str(STAND_IN), str(folder / name), name, *map(str, at)]
            self.processes.append(subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"}))

    def driver(self, **options: float) -> Ros2Driver:
        renamed = {name: PREFIX + name for name in self.robot.joint_names}
        return Ros2Driver(self.robot, self.joints, renamed=renamed, **{"started": 60.0, "silence": 10.0} | options)

    def followed(self) -> tuple[Array, Array]:
        """Times by the controllers' clock [ns], and states; of each only samples that were written whole."""
        times, found = [], []
        for name, joints in self.joints.items():
            lines = (self.folder / name).read_text().splitlines()[:-1]
            rows = np.array([json.loads(one) for one in lines])
            states = np.full((len(rows), self.robot.dof), np.nan)
            states[:, [self.robot.joint_names.index(joint) for joint in joints]] = rows[:, 1:]
            times.append(np.array([json.loads(one)[0] for one in lines], np.int64))
            found.append(states)
        return np.concatenate(times), np.concatenate(found)


@pytest.fixture(scope="module", autouse=True)
def _alone() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID")}
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    yield
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


@pytest.fixture
def stand_ins(robot: Robot, tmp_path: Path) -> Iterator[StandIns]:
    found = StandIns(robot, tmp_path)
    yield found
    for process in found.processes:
        process.send_signal(signal.SIGKILL)
        process.wait()


def motion_from(robot: Robot, q: Array, *ways: float) -> Trajectory:
    states = [q]
    for k, by in enumerate(ways):
        states.append(states[-1] + by * np.where(np.arange(robot.dof) % 8 == k, 1.0, 0.2))
    path = np.clip(states, robot.limits.lower, robot.limits.upper)
    return time_path(path, robot.limits, robot.joint_names).trajectory


def wait(driver: Ros2Driver, until: float) -> None:
    while driver.time < until:
        time.sleep(0.01)


def compare(stand_ins: StandIns, driver: Ros2Driver, commanded: list[tuple[float, Trajectory]]) -> int:
    """Compare each sample of the controllers with the motion that was commanded then; return how many moved."""
    times, states = stand_ins.followed()
    moving = 0
    for stamp, state in zip(times.tolist(), states, strict=True):
        now = (stamp - driver._zero) / 1e9
        sent = [(at, motion) for at, motion in commanded if at <= now]
        at, motion = sent[-1] if sent else (0.0, commanded[0][1].before(0.0))
        wanted = motion(min(now - at, motion.duration)) if sent else commanded[0][1].positions[0]
        known = np.isfinite(state)
        assert np.abs(state - wanted)[known].max() <= ALIKE, now
        moving += bool(sent) and 0.0 < now - at < motion.duration
    return moving


def test_controllers_follow_motions_and_handovers_in_the_middle(robot: Robot, stand_ins: StandIns) -> None:
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
    assert compare(stand_ins, driver, commanded) > 30
    driver.close()


def test_a_stop_over_the_network_ends_at_rest(robot: Robot, stand_ins: StandIns) -> None:
    driver = stand_ins.driver()
    motion = motion_from(robot, robot.home, 0.8)
    start = driver.time + 0.1
    driver.send(motion, start)
    wait(driver, start + 0.3 * motion.duration)
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
from test_ros2 import PREFIX, motion_from
robot = load_robot("dual_panda_softhand")
joints = {joints!r}
driver = Ros2Driver(robot, joints, renamed={{name: PREFIX + name for name in robot.joint_names}}, started=60.0)
motion = motion_from(robot, robot.home, 0.4)
driver.send(motion, driver.time + 0.1)
time.sleep(0.1 + 0.5 * motion.duration)
os.kill(os.getpid(), 9)
"""


def test_a_client_that_is_killed_leaves_the_robot_at_rest(robot: Robot, stand_ins: StandIns) -> None:
    code = KILLED.format(
        helpers=str(ROOT / "tests" / "helpers"), tests=str(ROOT / "tests" / "drivers"), joints=stand_ins.joints
    )
    killed = subprocess.run([sys.executable, "-c", code], check=False, timeout=120)
    assert killed.returncode == -signal.SIGKILL
    time.sleep(1.0)
    motion = motion_from(robot, robot.home, 0.4)
    times, states = stand_ins.followed()
    late = times > times.max() - 3 * 10**8
    assert late.sum() > 5
    off = np.abs(states[late] - motion.positions[-1])
    assert np.nanmax(off) <= ALIKE


def test_robots_that_do_not_answer_are_named(robot: Robot) -> None:
    with pytest.raises(DriverError, match="no state of left_joint1, .* came on /joint_states in 0.3 s"):
        Ros2Driver(robot, "arms", started=0.3)
    with pytest.raises(ParameterError, match="controllers: expected one controller for each joint"):
        Ros2Driver(robot, {"arms": robot.joint_names[:3]})
    with pytest.raises(ParameterError, match="renamed: expected joints of"):
        Ros2Driver(robot, "arms", renamed={"elbow": "e"})
    with pytest.raises(ParameterError, match="lead"):
        Ros2Driver(robot, "arms", lead=-1.0)


def test_a_robot_that_falls_silent_is_noticed(robot: Robot, stand_ins: StandIns) -> None:
    driver = stand_ins.driver(silence=1.0)
    assert driver.state().stamp <= driver.time
    for process in stand_ins.processes:
        process.send_signal(signal.SIGSTOP)
    wait(driver, driver.time + 1.5)
    with pytest.raises(DriverError, match="no joint states for"):
        driver.state()
    driver.close()
