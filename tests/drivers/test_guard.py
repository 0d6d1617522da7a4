"""What every driver does where the robot is not where its motion is: refuse, stop on the path, say so, recover."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

from apex_ompl.drivers import BagDriver, Guard, KinematicDriver, MujocoDriver
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

NEAR = {"kinematic": 1e-9, "bag": 1e-9, "mujoco": 2e-3}
JOINT, HAND = 3, 14


class Pushed:
    """A driver at the robot's home, whose robot is pushed by some radians, in physics by a torque."""

    def __init__(self, kind: str, robot: Robot, guard: Guard) -> None:
        self.kind, self.robot, self.near = kind, robot, NEAR[kind]
        self.driver: Any
        if kind == "mujoco":
            pytest.importorskip("mujoco")
            self.driver = MujocoDriver(robot, guard=guard)
        elif kind == "bag":
            pytest.importorskip("rosbags")
            self.driver = BagDriver(robot, Path(mkdtemp()) / "bag", guard=guard)
        else:
            self.driver = KinematicDriver(robot, guard=guard)

    def push(self, joint: int, by: float, torque: float) -> None:
        if self.kind == "mujoco":
            self.driver.data.qfrc_applied[self.driver.twin.v[joint]] = torque
        else:
            self.driver.push(by * (np.arange(self.robot.dof) == joint))

    def motion(self, *ways: tuple[int, float], q: Array | None = None) -> Trajectory:
        start = self.robot.home if q is None else q
        goal = start + sum(by * (np.arange(self.robot.dof) == joint) for joint, by in ways)
        return time_path(np.stack([start, goal]), self.robot.limits, self.robot.joint_names).trajectory

    def until_fault(self, most: float = 0.5) -> float:
        end = self.driver.time + most
        while not self.driver.fault and self.driver.time < end:
            self.driver.advance(self.driver.time + 0.002)
        return float(self.driver.time)


@pytest.fixture(params=NEAR)
def pushed(request: pytest.FixtureRequest, robot: Robot) -> Callable[[Guard], Pushed]:
    return lambda guard: Pushed(request.param, robot, guard)


def test_a_robot_that_moves_may_be_off_at_a_handover_as_far_as_when_it_follows(
    pushed: Callable[[Guard], Pushed],
) -> None:
    for tracking, refused in ((0.05, False), (0.004, True)):
        tried = pushed(Guard(start=0.003, tracking=tracking))
        first = tried.motion((0, 0.9))
        tried.driver.send(first, 0.0)
        tried.push(JOINT, 0.008, 28.0)
        tried.driver.advance(0.2)
        assert float(np.abs(tried.driver.state().positions - first(0.2))[JOINT]) > 0.004
        if refused:
            assert "off its commanded position" in tried.driver.fault
        else:
            tried.driver.send(first.after(0.25), 0.25)
            tried.driver.advance(0.26)
            assert not tried.driver.fault and tried.driver.end > 0.3


def test_a_robot_that_settles_after_its_motion_may_be_off_as_far_as_during_it(
    pushed: Callable[[Guard], Pushed],
) -> None:
    for later, refused in ((0.05, False), (0.2, True)):
        tried = pushed(Guard(start=0.003))
        first = tried.motion((0, 0.2))
        tried.driver.send(first, 0.0)
        tried.push(JOINT, 0.008, 28.0)
        at = first.duration + later
        tried.driver.advance(at)
        assert float(np.abs(tried.driver.state().positions - first(first.duration))[JOINT]) > 0.004
        second = tried.motion((1, 0.2), q=first(first.duration))
        if refused:
            with pytest.raises(DriverError, match=r"off the start of the motion .* at most 0\.003"):
                tried.driver.send(second, at)
        else:
            tried.driver.send(second, at)
            assert tried.driver.end > at + 0.1


def test_a_start_off_the_measured_position_is_refused(pushed: Callable[[Guard], Pushed]) -> None:
    tried = pushed(Guard(start=0.003))
    tried.push(JOINT, 0.008, 28.0)
    tried.driver.advance(0.5)
    off = float((tried.driver.state().positions - tried.robot.home)[JOINT])
    assert off > 0.004 and not tried.driver.fault
    with pytest.raises(DriverError, match=r"left_joint4 is 0\.00\d+ off the start of the motion .* at most 0\.003"):
        tried.driver.send(tried.motion((0, 0.3)), 0.5)
    tried.driver.advance(0.6)
    assert tried.driver.end <= 0.5  # nothing is commanded
    pushed(Guard(start=None)).driver.send(tried.motion((0, 0.3)), 0.5)
    tried.push(JOINT, 0.0, 0.0)
    tried.driver.advance(1.2)
    tried.driver.send(tried.motion((0, 0.3)), 1.2)


def test_a_tracking_error_stops_the_robot_on_the_path(pushed: Callable[[Guard], Pushed]) -> None:
    tried = pushed(Guard())
    motion, limits = tried.motion((0, 0.5), (JOINT, 0.3)), tried.robot.limits
    tried.driver.send(motion, 0.0)
    tried.driver.advance(0.3 * motion.duration)
    tried.push(JOINT, -0.07, -130.0)
    stopped_at = tried.until_fault()
    assert "left_joint4 was 0.0" in tried.driver.fault and "more than 0.05" in tried.driver.fault
    with pytest.raises(DriverError, match="the robot was stopped, since left_joint4 was"):
        tried.driver.send(motion, tried.driver.time + 0.1)
    assert stopped_at < tried.driver.end < motion.duration
    tried.push(JOINT, 0.0, 0.0)
    tried.driver.advance(tried.driver.end + 1.0)
    stop = min((motion.stop_at(max(stopped_at - k / 1000, 0), limits) for k in range(4)),
               key=lambda one: np.abs(one.positions[-1] - tried.driver.state().positions).max())  # fmt: skip
    state = tried.driver.state()
    assert np.abs(state.positions - stop.positions[-1]).max() <= tried.near  # where the stop of that time ends
    line = motion.positions[-1] - motion.positions[0]
    share = (stop.positions[-1] - motion.positions[0]) @ line / (line @ line)
    assert 0.3 < share < 0.95 and np.abs(stop.positions[-1] - motion.positions[0] - share * line).max() < 1e-3
    tried.driver.recover()
    assert not tried.driver.fault
    back = tried.motion((0, -0.1), q=tried.driver.state().positions)
    tried.driver.send(back, tried.driver.time)
    tried.driver.advance(tried.driver.end + 0.3)
    assert np.abs(tried.driver.state().positions - back.positions[-1]).max() <= tried.near


def test_a_robot_pushed_at_rest_is_noticed_and_recovers_where_it_is(pushed: Callable[[Guard], Pushed]) -> None:
    tried = pushed(Guard(tracking=0.02))
    tried.push(0, 0.03, 120.0)
    tried.until_fault()
    assert "left_joint1 was 0.0" in tried.driver.fault
    with pytest.raises(DriverError, match="recover"):
        tried.driver.send(tried.motion((0, 0.1)), tried.driver.time)
    if tried.kind == "mujoco":
        with pytest.raises(DriverError, match="the robot moves, left_joint1 at"):
            tried.driver.recover()
        tried.push(0, 0.0, 0.0)
        tried.driver.advance(tried.driver.time + 0.5)
    measured = tried.driver.state().positions
    tried.driver.recover()
    tried.driver.send(tried.motion((1, 0.1), q=measured), tried.driver.time)


def test_hands_are_guarded_where_asked_for(pushed: Callable[[Guard], Pushed]) -> None:
    free, guarded = pushed(Guard()), pushed(Guard(hand_start=0.05, hand_tracking=0.2))
    for tried in (free, guarded):
        tried.push(HAND, 0.3, 100.0)
        tried.until_fault(0.3)
    name = free.robot.joint_names[HAND]
    assert not free.driver.fault and f"{name} was 0." in guarded.driver.fault
    assert (free.driver.state().positions - free.robot.home)[HAND] > 0.2
    free.driver.send(free.motion((0, 0.1)), free.driver.time)


def test_states_that_are_not_numbers_stop_the_robot(robot: Robot) -> None:
    driver = KinematicDriver(robot)
    driver.send(Pushed("kinematic", robot, Guard()).motion((0, 0.5)), 0.0)
    driver.advance(0.2)
    driver.push(np.full(robot.dof, np.nan))
    assert "left_joint1 was nan off" in driver.fault and driver.end > 0.2
    with pytest.raises(ParameterError, match="by"):
        driver.push(np.zeros(3))


def test_distances_are_checked() -> None:
    for bad in (0.0, -1.0, float("nan"), "far"):
        with pytest.raises(ParameterError, match="guard: tracking: expected a positive number"):
            Guard(tracking=bad)  # type: ignore[arg-type]
