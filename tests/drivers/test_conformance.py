"""What every driver does: late, overlapping and repeated motions, stops in the middle, and what it refuses."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from loops import FAR, PROBLEM, ByHand, line, setup_of

from apex_ompl import Loop, LoopSettings, problems
from apex_ompl.drivers import BagDriver, Driver, KinematicDriver, MujocoDriver
from apex_ompl.errors import ParameterError
from apex_ompl.loop.result import Outcome
from apex_ompl.robot import Robot
from apex_ompl.scene.scripts import standing
from apex_ompl.timing import Trajectory, time_path
from apex_ompl.types import Array

NEAR = {"kinematic": 1e-9, "bag": 1e-9, "mujoco": 1e-3}  # of a state to the commanded one [rad]
AT_REST = {"kinematic": 1e-9, "bag": 1e-9, "mujoco": 0.02}  # of a joint's speed [rad/s]
STEP = 0.01


def mujoco_driver(robot: Robot, state: Array) -> MujocoDriver:
    pytest.importorskip("mujoco")
    return MujocoDriver(robot, state=state)


def bag_driver(robot: Robot, state: Array) -> BagDriver:
    pytest.importorskip("rosbags")
    return BagDriver(robot, Path(mkdtemp()) / "bag", state=state)


MAKERS: dict[str, Callable[[Robot, Array], Any]] = {
    "kinematic": KinematicDriver, "bag": bag_driver, "mujoco": mujoco_driver,
}  # fmt: skip


class Tried:
    """A driver at the robot's home, and what may be expected of it."""

    def __init__(self, kind: str, robot: Robot) -> None:
        self.robot, self.driver = robot, MAKERS[kind](robot, robot.home)
        self.near, self.at_rest = NEAR[kind], AT_REST[kind]

    def motion(self, *ways: tuple[int, float], q: Array | None = None) -> Trajectory:
        """A motion through states, each a step of one joint."""
        states = [self.robot.home if q is None else q]
        for joint, by in ways:
            states.append(states[-1] + by * (np.arange(self.robot.dof) == joint))
        return time_path(np.stack(states), self.robot.limits, self.robot.joint_names).trajectory

    def follow(self, until: float, wanted: Callable[[float], Array]) -> None:
        """Advance to a time, and check that the robot is where it should be on the way."""
        while self.driver.time < until - 0.6e-3:  # a step of physics is 1 ms
            self.driver.advance(min(self.driver.time + STEP, until))
            state = self.driver.state()
            assert np.abs(state.positions - wanted(state.stamp)).max() <= self.near, state.stamp

    def rests(self, wanted: Array) -> None:
        """Check that the robot rests somewhere, and stays."""
        for _ in range(3):
            state = self.driver.state()
            assert np.abs(state.velocities).max() <= self.at_rest
            assert np.abs(state.positions - wanted).max() <= self.near
            self.driver.advance(self.driver.time + 0.1)


@pytest.fixture(params=MAKERS)
def tried(request: pytest.FixtureRequest, robot: Robot) -> Any:
    found = Tried(request.param, robot)
    yield found
    found.driver.close()


def at(motion: Trajectory, start: float) -> Callable[[float], Array]:
    return lambda time: motion(min(max(time - start, 0.0), motion.duration))


def test_a_motion_is_followed_from_its_time_on_to_rest(tried: Tried) -> None:
    driver: Driver = tried.driver
    motion = tried.motion((0, 0.4), (3, 0.3))
    assert driver.names == motion.joint_names and driver.limits is tried.robot.limits
    tried.rests(tried.robot.home)
    start = tried.driver.time + 0.05
    driver.send(motion, start)
    tried.follow(start + motion.duration, at(motion, start))
    tried.driver.advance(tried.driver.time + 0.2)
    tried.rests(motion.positions[-1])


def test_a_motion_that_comes_late_changes_nothing(tried: Tried) -> None:
    motion = tried.motion((0, 0.4))
    tried.driver.send(motion, 0.0)
    tried.follow(0.2, at(motion, 0.0))
    with pytest.raises(ParameterError, match="at: expected a time that is not over"):
        tried.driver.send(motion.stop_at(0.1, tried.robot.limits), 0.0)
    tried.follow(motion.duration, at(motion, 0.0))


def test_a_motion_replaces_what_is_under_way_and_what_waits(tried: Tried) -> None:
    whole, limits = tried.motion((0, 0.5), (3, 0.4)), tried.robot.limits
    half = whole.stop_at(0.3, limits)
    tried.driver.send(whole, 0.0)
    tried.driver.send(whole, 0.0)  # again
    tried.follow(0.1, at(whole, 0.0))
    rest = half.after(0.2)  # from the state at 0.2 s on
    tried.driver.send(rest, 0.2)
    back = tried.motion((3, -0.2), q=half.positions[-1])
    tried.driver.send(back, half.duration + 0.1)
    tried.driver.send(rest, 0.2)  # again, so that the motion back is dropped
    tried.follow(half.duration + 0.2, at(half, 0.0))
    tried.driver.advance(tried.driver.time + 0.2)
    tried.rests(half.positions[-1])


def test_a_stop_in_the_middle_ends_at_rest_on_the_path(tried: Tried) -> None:
    motion = tried.motion((0, 0.6))
    tried.driver.send(motion, 0.0)
    tried.driver.send(tried.motion((1, 0.2), q=motion.positions[-1]), motion.duration + 0.5)
    tried.follow(0.4 * motion.duration, at(motion, 0.0))
    tried.driver.stop()
    stopped = motion.stop_at(tried.driver.time, tried.robot.limits)
    tried.follow(stopped.duration + 0.1, at(stopped, 0.0))
    tried.driver.advance(motion.duration + 1.0)
    end = stopped.positions[-1]
    tried.rests(end)
    line = motion.positions[-1] - motion.positions[0]
    share = (end - motion.positions[0]) @ line / (line @ line)
    assert 0.4 < share < 0.95 and np.abs(end - motion.positions[0] - share * line).max() < 1e-6
    tried.driver.stop()  # at rest already
    tried.rests(end)


def test_a_stop_at_the_start_of_a_motion_leaves_the_robot_at_rest(tried: Tried) -> None:
    tried.driver.send(tried.motion((0, 0.6)), 0.0)
    tried.driver.stop()
    tried.driver.advance(0.2)
    state = tried.driver.state()
    assert np.abs(state.positions - tried.robot.home).max() < 1e-4 + tried.near  # the shortest stop that there is
    tried.rests(state.positions)


def test_what_cannot_be_followed_is_refused_and_changes_nothing(tried: Tried) -> None:
    motion, robot = tried.motion((0, 0.4)), tried.robot
    states = {name: getattr(motion, name) for name in ("positions", "velocities", "accelerations")}
    fast = Trajectory(0.5 * motion.times, states["positions"], 2 * states["velocities"], 4 * states["accelerations"],
                      motion.joint_names)  # fmt: skip
    cases = {
        "limit": fast,
        "ends at rest": motion.before(0.5 * motion.duration),
        "a start within": tried.motion((0, 0.4), q=robot.home + 0.01),
        "the joints": replace(motion, joint_names=motion.joint_names[::-1]),
    }
    for words, one in cases.items():
        with pytest.raises(ParameterError, match=words):
            tried.driver.send(one, 0.0)
    with pytest.raises(ParameterError, match="at"):
        tried.driver.send(motion, float("nan"))
    tried.driver.advance(0.2)
    tried.rests(robot.home)


def test_a_closed_driver_says_so(tried: Tried) -> None:
    tried.driver.close()
    for call in (tried.driver.state, tried.driver.stop, lambda: tried.driver.send(tried.motion((0, 0.1)), 1.0)):
        with pytest.raises(ParameterError, match="driver: expected an open one"):
            call()


@pytest.mark.parametrize("kind", MAKERS)
def test_the_loop_reaches_a_goal_by_a_driver(kind: str, robot: Robot) -> None:
    setup = setup_of(PROBLEM)
    driver = MAKERS[kind](robot, setup.start)
    settings = LoopSettings(error=0.024, fastest=0.4, timeout=10.0)
    with Loop(problems.load(PROBLEM), ByHand(line), settings=settings, process=False, tolerance=0.01) as loop:
        while loop.outcome is None:
            loop.observe(driver.time, [standing(FAR)])
            command = loop.step(driver.time, driver.state().positions)
            if command is not None:
                driver.send(command.motion, command.at)
            driver.advance(driver.time + settings.period)
    assert loop.outcome is Outcome.REACHED, loop.reason
    driver.advance(driver.time + 0.2)
    goals = setup.valid_goals
    assert np.abs(driver.state().positions - goals).max(axis=1).min() < 1e-3


def test_a_driver_on_a_clock_of_the_callers_is_used_from_threads(robot: Robot) -> None:
    now = [5.0]
    driver = KinematicDriver(robot, clock=lambda: now[0])
    motion = Tried("kinematic", robot).motion((0, 0.3))
    threads = [threading.Thread(target=driver.send, args=(motion, 6.0)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    now[0] = 6.0 + 0.5 * motion.duration
    state = driver.state()
    assert state.stamp == now[0] and np.abs(state.positions - motion(0.5 * motion.duration)).max() < 1e-9
    with pytest.raises(ParameterError, match="until"):
        driver.advance(20.0)


def test_a_state_outside_the_limits_is_refused(robot: Robot) -> None:
    for state in (robot.limits.upper + 0.1, np.full(robot.dof, np.nan), robot.home[:3]):
        with pytest.raises(ParameterError, match="state"):
            KinematicDriver(robot, state)
