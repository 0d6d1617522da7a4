"""The driver of Franka's arms against stand-ins for both packages, which are exactly at their last reference."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stand_ins_of_franka import STAND_INS, stand_ins
from support import ROOT

from apex_ompl.drivers import FrankaDriver, FrankaSettings
from apex_ompl.errors import DriverError, MissingFileError, ParameterError
from apex_ompl.robot import Robot
from apex_ompl.robot.dynamics import Dynamics
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

ADDRESSES = "left.arm", "right.arm"
SETTINGS = FrankaSettings(rate=250.0, realtime=False, lead=0.03)


def arms(robot: Robot) -> dict[str, tuple[str, ...]]:
    return {ADDRESSES[0]: robot.joint_names[:7], ADDRESSES[1]: robot.joint_names[7:14]}


def motion_from(robot: Robot, q: Array, *ways: float) -> Trajectory:
    """A motion of both arms through states, each a step of a joint of both."""
    states = [q]
    for k, by in enumerate(ways):
        states.append(states[-1] + by * (np.arange(14) % 7 == k))
    limits = type(robot.limits)(*(row[:14] for row in vars(robot.limits).values()))
    return time_path(np.stack(states), limits, robot.joint_names[:14]).trajectory


class Arms:
    """A driver of two stand-ins, and what they were given."""

    def __init__(self, robot: Robot, folder: Path, package: str) -> None:
        self.robot, self.folder = robot, folder
        for address in ADDRESSES:
            (folder / f"{address}.there").touch()
        self.driver = FrankaDriver(robot, arms(robot), package=package, settings=SETTINGS)

    def rows(self) -> list[Array]:
        """References of each arm: time on the driver's clock, positions, velocities, torques; shape (N, 22)."""
        found = []
        for address in ADDRESSES:
            text = (self.folder / address).read_text()
            rows = np.array([line.split() for line in text[: text.rfind("\n")].splitlines()], float)
            rows[:, 0] -= self.driver._zero
            found.append(rows)
        return found

    def write(self, name: str, text: str) -> None:
        """Write a file for a stand-in, which never sees a part of it."""
        (self.folder / "new").write_text(text)
        (self.folder / "new").rename(self.folder / name)

    def wait(self, until: float) -> None:
        while self.driver.time < until:
            time.sleep(0.005)


@pytest.fixture(params=["panda-python", "franky-control"])
def both(
    request: pytest.FixtureRequest, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Arms]:
    yield from arms_of(request.param, robot, tmp_path, monkeypatch)


@pytest.fixture
def franky(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Arms]:
    yield from arms_of("franky-control", robot, tmp_path, monkeypatch)


def arms_of(package: str, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Arms]:
    with stand_ins(monkeypatch):
        monkeypatch.setenv("FRANKA_STAND_IN", str(tmp_path))
        found = Arms(robot, tmp_path, package)
        yield found
        found.driver.close()


def off(rows: Array, wanted: Callable[[float], Array], half: float) -> Array:
    """How far references are off what is commanded in the middle of their cycle, to 50 us of motion, shape (N,) [rad].

    The time of a reference is read a little after that of its cycle, on a busy machine longer after it.
    """
    spread = np.linspace(-0.002, 0.001, 61)
    return np.array([min(np.abs(row[1:8] - wanted(row[0] + half + by)).max() for by in spread) for row in rows])


def test_motions_handovers_and_stops_reach_both_arms(both: Arms) -> None:
    driver, robot = both.driver, both.robot
    assert driver.names == robot.joint_names[:14] and "14 joints" in repr(driver)
    first = motion_from(robot, robot.home[:14], 0.4, 0.2)
    start = driver.time + 0.1
    driver.send(first, start)
    half = 0.5 * first.duration
    both.wait(start + half - 0.1)
    second = first.stop_at(half + 0.05, robot_limits(robot)).after(half)
    driver.send(second, start + half)  # in the middle
    both.wait(driver.end + 0.05)
    state = driver.state()
    assert np.abs(state.positions - second.positions[-1]).max() < 1e-6 and not state.velocities.any()
    third = motion_from(robot, second.positions[-1], -0.9)
    again = driver.time + 0.1
    driver.send(third, again)
    both.wait(again + 0.4 * third.duration)
    driver.stop()
    stopped = driver.end
    assert stopped < again + third.duration
    both.wait(stopped + 0.05)
    state = driver.state()
    line = third.positions[-1] - third.positions[0]
    share = (state.positions - third.positions[0]) @ line / (line @ line)
    assert 0.3 < share < 0.98 and np.abs(state.positions - third.positions[0] - share * line).max() < 1e-3

    def wanted(now: float) -> Array:
        at, motion = [(0.0, first), (start, first), (start + half, second)][
            int(now >= start) + int(now >= start + half)
        ]
        return motion(np.clip(now - at, 0.0, motion.duration)) if now >= start else first.positions[0]

    for k, rows in enumerate(both.rows()):
        before = rows[rows[:, 0] < again - 0.05]
        assert ((before[:, 0] > start) & (before[:, 0] < start + half)).sum() > 20
        apart = off(before, lambda now, k=k: wanted(now)[7 * k : 7 * k + 7], 0.5 / SETTINGS.rate)
        assert np.quantile(apart, 0.9) < 1.2e-4
    left, right = both.rows()
    count = min(len(left), len(right))
    apart = np.abs(left[:count, 0] - right[:count, 0])
    assert np.median(apart) < 1e-3  # of the two arms' references in a cycle


def robot_limits(robot: Robot) -> Any:
    return type(robot.limits)(*(row[:14] for row in vars(robot.limits).values()))


def test_feedforward_is_that_of_the_inertia(franky: Arms) -> None:
    robot, driver = franky.robot, franky.driver
    motion = motion_from(robot, robot.home[:14], 0.5)
    start = driver.time + 0.1
    driver.send(motion, start)
    franky.wait(driver.end + 0.05)
    dynamics, seen = Dynamics(robot), 0
    for k, rows in enumerate(franky.rows()):
        for row in rows[(rows[:, 0] > start + 0.05) & (rows[:, 0] < start + motion.duration - 0.05)]:
            at = min(np.linspace(-0.05, 0.003, 1061) + row[0] - start,
                     key=lambda t: np.abs(motion(t)[7 * k : 7 * k + 7] - row[1:8]).max())  # fmt: skip
            q, a = robot.home.copy(), np.zeros(robot.dof)
            q[:14], a[7 * k : 7 * k + 7] = motion(at), motion(at, 2)[7 * k : 7 * k + 7]
            wanted = (dynamics.torques(q[None], None, a[None]) - dynamics.torques(q[None]))[0, 7 * k : 7 * k + 7]
            assert np.abs(row[15:] - wanted).max() < 0.05 * np.abs(wanted).max() + 0.1
            seen += np.abs(wanted).max() > 2.0
    assert seen > 20


def test_an_arm_that_fails_stops_the_other_one_on_the_path(franky: Arms) -> None:
    both, robot, driver = franky, franky.robot, franky.driver
    motion = motion_from(robot, robot.home[:14], 0.6)
    start = driver.time + 0.1
    driver.send(motion, start)
    both.wait(start + 0.4 * motion.duration)
    both.write("right.arm.fault", "libfranka: Move command aborted: cartesian_reflex")
    both.wait(driver.time + 0.1)
    assert driver.fault == "the arm at right.arm: libfranka: Move command aborted: cartesian_reflex"
    assert driver.end < start + motion.duration
    with pytest.raises(DriverError, match="the robot was stopped, since the arm at right.arm"):
        driver.send(motion, driver.time + 0.1)
    both.wait(driver.end + 0.1)
    left = both.rows()[0]
    assert not left[-1, 8:15].any() and robot.home[0] + 0.2 < left[-1, 1] < robot.home[0] + 0.58
    assert np.abs(left[-1, 2:8] - robot.home[1:7]).max() < 1e-3
    driver.recover()
    assert not driver.fault
    back = motion_from(robot, driver.state().positions, -0.1)
    driver.send(back, driver.time + 0.1)
    both.wait(driver.end + 0.05)
    assert np.abs(driver.state().positions - back.positions[-1]).max() < 1e-6


def test_an_arm_off_its_motion_stops_both(franky: Arms) -> None:
    robot, driver = franky.robot, franky.driver
    motion = motion_from(robot, robot.home[:14], 0.6).slower(4.0)  # of which a busy machine sends little too late
    franky.write("left.arm.off", "0.02")
    franky.wait(driver.time + 0.05)
    with pytest.raises(DriverError, match="left_joint1 is 0.02 off the start of the motion"):
        driver.send(motion, driver.time + 0.1)
    franky.write("left.arm.off", "0.0")
    franky.wait(driver.time + 0.05)
    start = driver.time + 0.1
    driver.send(motion, start)
    franky.wait(start + 0.35 * motion.duration)
    franky.write("left.arm.off", "-0.06")
    franky.wait(driver.time + 0.05)
    assert "left_joint1 was 0.0" in driver.fault and "more than 0.05" in driver.fault
    franky.wait(driver.end + 0.1)
    right = franky.rows()[1]
    assert not right[-1, 8:15].any() and robot.home[0] + 0.1 < right[-1, 1] < robot.home[0] + 0.58


KILLED = """
import os, sys, time
sys.path[:0] = {path!r}
from apex_ompl.drivers import FrankaDriver, FrankaSettings
from apex_ompl.robot import load_robot
from test_franka import SETTINGS, arms, motion_from
robot = load_robot("dual_panda_softhand")
driver = FrankaDriver(robot, arms(robot), package="panda-python", settings=SETTINGS)
motion = motion_from(robot, robot.home[:14], 0.5)
driver.send(motion, driver.time + 0.1)
time.sleep(0.1 + 0.4 * motion.duration)
print(driver._process.pid, flush=True)
os.kill(os.getpid(), 9)
"""


def test_a_client_that_is_killed_leaves_the_arms_at_rest(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FRANKA_STAND_IN", str(tmp_path))
    for address in ADDRESSES:
        (tmp_path / f"{address}.there").touch()
    path = [str(STAND_INS), str(ROOT / "tests" / "helpers"), str(ROOT / "tests" / "drivers")]
    killed = subprocess.run(
        [sys.executable, "-c", KILLED.format(path=path)], check=False, timeout=120, stdout=subprocess.PIPE
    )
    assert killed.returncode == -signal.SIGKILL
    until = time.monotonic() + 10.0
    while Path(f"/proc/{int(killed.stdout)}").exists() and time.monotonic() < until:
        time.sleep(0.02)
    assert not Path(f"/proc/{int(killed.stdout)}").exists()  # it has nothing more to do
    goal = motion_from(robot, robot.home[:14], 0.5).positions[-1]
    for k, address in enumerate(ADDRESSES):
        last = np.array((tmp_path / address).read_text().splitlines()[-1].split(), float)
        assert np.abs(last[1:8] - goal[7 * k : 7 * k + 7]).max() < 1e-9 and not last[8:15].any()


def test_arms_that_do_not_answer_and_bad_calls(robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FRANKA_STAND_IN", str(tmp_path))
    (tmp_path / "left.arm.there").touch()
    with stand_ins(monkeypatch):
        words = "the arm at right.arm cannot be connected: libfranka: Connection to FCI"
        with pytest.raises(DriverError, match=words):
            FrankaDriver(robot, arms(robot), package="panda-python", settings=SETTINGS)
        with pytest.raises(ParameterError, match="package: expected panda-python or franky-control, since both are"):
            FrankaDriver(robot, arms(robot), settings=SETTINGS)
    with pytest.raises(ParameterError, match="package: expected panda-python or franky-control, got 'libfranka'"):
        FrankaDriver(robot, arms(robot), package="libfranka")
    with pytest.raises(ParameterError, match="arms: expected seven joints of each arm"):
        FrankaDriver(robot, {"a": robot.joint_names[:6]})
    with pytest.raises(ParameterError, match="joints: expected some of the joints"):
        FrankaDriver(robot, {"a": robot.joint_names[:7], "b": robot.joint_names[:7]})
    with pytest.raises(ParameterError, match="stiffness"):
        FrankaSettings(stiffness=(600.0,) * 6)
    with pytest.raises(ParameterError, match="rate"):
        FrankaSettings(rate=0.0)


def test_a_missing_package_is_named(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(MissingFileError, match=r"package for Franka's arms 'franky'.*apex-ompl\[fr3\]"):
        FrankaDriver(robot, arms(robot), package="franky-control")


def test_motions_are_sent_ahead(franky: Arms) -> None:
    motion = motion_from(franky.robot, franky.robot.home[:14], 0.3)
    with pytest.raises(ParameterError, match="at: expected a time that is not over"):
        franky.driver.send(motion, franky.driver.time + 0.01)
    os.kill(franky.driver._process.pid, signal.SIGSTOP)
    franky.wait(franky.driver.time + 0.2)
    with pytest.raises(DriverError, match="the process that drives the arms was silent"):
        franky.driver.send(motion, franky.driver.time + 0.2)
    os.kill(franky.driver._process.pid, signal.SIGCONT)
    franky.driver.close()
    with pytest.raises(ParameterError, match="driver: expected an open one"):
        franky.driver.state()
