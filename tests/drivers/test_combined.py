"""Arms and hands by drivers of their own, as one robot."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from apex_ompl.drivers import CombinedDriver, FunctionDriver, Guard, KinematicDriver
from apex_ompl.errors import DriverError, ParameterError
from apex_ompl.robot import Robot
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

ARMS, HANDS = slice(0, 14), slice(14, 16)


def motion_from(robot: Robot, q: Array, by: float) -> Trajectory:
    goal = q + by * np.where(np.arange(robot.dof) < 14, 1.0, 0.5) * (np.arange(robot.dof) % 7 == 0)
    return time_path(np.stack([q, goal]), robot.limits, robot.joint_names).trajectory


class Both:
    """Exact arms and hands, the hands' clock 5 s ahead, as one robot."""

    def __init__(self, robot: Robot, guard: Guard | None = None) -> None:
        self.robot, self.now = robot, 0.0
        self.arms = KinematicDriver(
            robot, clock=lambda: self.now, joints=robot.joint_names[ARMS], guard=guard
        )  # fmt: skip
        self.hands = KinematicDriver(robot, clock=lambda: 5.0 + self.now, joints=robot.joint_names[HANDS])
        self.driver = CombinedDriver(robot, [self.hands, self.arms], watch=None)

    def follow(self, until: float) -> Iterator[tuple[float, Array]]:
        """Time since the start of the test, and the state of the whole, up to a time."""
        while self.now < until:
            self.now += 0.01
            yield self.now, self.driver.state().positions


def test_a_motion_is_split_and_followed_together(robot: Robot) -> None:
    both = Both(robot)
    motion = motion_from(robot, robot.home, 1.2)
    assert motion.positions[-1, 14] != motion.positions[0, 14]
    assert both.driver.names == robot.joint_names and both.hands.names == robot.joint_names[HANDS]
    start = both.driver.time + 0.1
    both.driver.send(motion, start)
    for now, q in both.follow(0.4 * motion.duration):
        assert np.abs(q - motion(min(max(now - 0.1, 0.0), motion.duration))).max() < 1e-9
    both.driver.stop()
    stop = motion.stop_at(both.now + 0.05 - 0.1, robot.limits)
    for now, q in both.follow(motion.duration + 1.0):
        assert np.abs(q - stop(min(now - 0.1, stop.duration))).max() < 1e-9
    assert both.driver.end < 5.1 + motion.duration
    assert not both.driver.state().velocities.any()


def test_a_fault_of_one_stops_all_on_the_path(robot: Robot) -> None:
    both = Both(robot)
    motion = motion_from(robot, robot.home, 1.2)
    both.driver.send(motion, both.driver.time + 0.1)
    list(both.follow(0.4 * motion.duration))
    both.arms.push(0.06 * (np.arange(14) == 9))
    list(both.follow(motion.duration + 1.0))
    assert both.driver.fault.startswith("right_joint3 was 0.06 off")
    hands = both.hands.state()
    assert not hands.velocities.any()
    assert robot.home[14] < hands.positions[0] < motion.positions[-1, 14] - 0.01
    with pytest.raises(DriverError, match="the robot was stopped, since right_joint3"):
        both.driver.send(motion, both.driver.time + 0.1)
    q = both.driver.recover()
    assert np.abs(q - both.driver.state().positions).max() < 1e-9 and not both.driver.fault
    back = motion_from(robot, q, -0.2)
    both.driver.send(back, both.driver.time)
    list(both.follow(both.now + back.duration + 0.1))
    assert np.abs(both.driver.state().positions - back.positions[-1]).max() < 1e-9


def test_a_part_that_refuses_stops_all(robot: Robot) -> None:
    both = Both(robot, Guard(start=0.002))
    both.arms.push(0.004 * (np.arange(14) == 0))
    motion = motion_from(robot, robot.home, 1.2)
    with pytest.raises(DriverError, match="left_joint1 is 0.004 off the start"):
        both.driver.send(motion, both.driver.time + 0.1)
    list(both.follow(1.0))
    assert np.abs(both.hands.state().positions - robot.home[HANDS]).max() < 1e-3
    assert both.driver.fault.startswith("a part of the motion was refused")
    q = both.driver.recover()
    both.driver.send(motion_from(robot, q, 0.1), both.driver.time)


def test_joints_without_a_driver_or_with_two_are_refused(robot: Robot) -> None:
    arms = KinematicDriver(robot, joints=robot.joint_names[ARMS])
    for drivers in ([arms], [arms, KinematicDriver(robot)], []):
        with pytest.raises(ParameterError, match="drivers: expected each of the joints"):
            CombinedDriver(robot, drivers)
    with pytest.raises(ParameterError, match="joints: expected some of the joints"):
        KinematicDriver(robot, joints=["elbow"])


def test_closing_closes_all(robot: Robot) -> None:
    both = Both(robot)
    both.driver.close()
    for call in (both.driver.state, both.driver.stop, both.arms.state, both.hands.state):
        with pytest.raises(ParameterError, match="driver: expected an open one"):
            call()


class Hands:
    """Hands of a caller's, which are where they were commanded, or stuck."""

    def __init__(self) -> None:
        self.commanded = [np.array([0.2, 0.2])]
        self.stuck = False
        self.fails = False

    def command(self, q: Array) -> None:
        if self.fails:
            raise OSError("no bus")
        self.commanded.append(np.array(q))

    def measure(self) -> Array:
        return self.commanded[0 if self.stuck else -1]


def hand_motion(robot: Robot, by: float) -> Trajectory:
    start = robot.home.copy()
    start[HANDS] = 0.2
    goal = start + by * (np.arange(robot.dof) >= 14)
    whole = time_path(np.stack([start, goal]), robot.limits, robot.joint_names).trajectory
    return whole.selected(robot.joint_names[HANDS])


def wait(found: object, most: float = 5.0) -> None:
    end = time.monotonic() + most
    while not found() and time.monotonic() < end:  # type: ignore[operator]
        time.sleep(0.005)


def test_a_function_of_the_callers_moves_hands(robot: Robot) -> None:
    hands = Hands()
    driver = FunctionDriver(robot, robot.joint_names[HANDS], hands.command, hands.measure)
    motion = hand_motion(robot, 0.4)
    start = driver.time + 0.05
    driver.send(motion, start)
    driver.close()  # when the motion has ended
    assert driver.time >= start + motion.duration
    np.testing.assert_allclose(hands.commanded[-1], 0.6, atol=1e-9)
    given = np.array(hands.commanded[1:])[:, 0]
    assert (np.diff(given) >= -1e-12).all() and ((given > 0.21) & (given < 0.59)).sum() >= 5


@pytest.mark.parametrize("what", ["stuck", "fails"])
def test_hands_that_do_not_follow_are_stopped(robot: Robot, what: str) -> None:
    hands = Hands()
    driver = FunctionDriver(
        robot, robot.joint_names[HANDS], hands.command, hands.measure, guard=Guard(hand_tracking=0.1)
    )  # fmt: skip
    motion = hand_motion(robot, 0.6).slower(5.0)  # so that there is time to stop on a busy machine
    start = driver.time + 0.02
    driver.send(motion, start)
    wait(lambda: driver.time > start + 0.1)
    setattr(hands, what, True)
    wait(lambda: driver.fault)
    words = {
        "stuck": "left_hand_synergy was 0.1",
        "fails": "commands of left_hand_synergy, right_hand_synergy failed: no",
    }
    assert words[what] in driver.fault and driver.end < start + motion.duration
    with pytest.raises(DriverError, match="the robot was stopped"):
        driver.send(motion, driver.time + 0.1)
    driver.close()
    assert not driver._thread.is_alive()
