"""Motions that are followed in physics: errors, contacts, torques, stops, held objects, moving obstacles, pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from physics import library
from planning import cached_problem
from support import ROOT

from apex_ompl import plan
from apex_ompl.drivers import Driver, MujocoDriver, TwinSettings
from apex_ompl.errors import ApexError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.robot import Robot
from apex_ompl.robot.dynamics import Dynamics
from apex_ompl.scene.bodies import AttachedObject, Obstacle, pose_fields
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import Timing, Trajectory, time_path

library()


@pytest.fixture(scope="module")
def problem() -> Problem:
    return cached_problem("peg_in_hole")


@pytest.fixture(scope="module")
def motion(problem: Problem) -> Trajectory:
    found = plan(problem, timeout=60.0, seed=1).trajectory
    assert found is not None
    return found


@pytest.fixture(scope="module")
def followed(robot: Robot, problem: Problem, motion: Trajectory) -> MujocoDriver:
    driver = MujocoDriver(robot, problem)
    driver.send(motion, 0.1)
    driver.advance(0.5 + motion.duration)
    return driver


def at_home(robot: Robot, *scene: Obstacle, **more: Any) -> Problem:
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    return Problem(name="home", robot=robot.name, scene=scene, start=home, goal=Goal(joints=(home,)), **more)


def lifted(robot: Robot, by: float = 0.5, timing: Timing | None = None) -> Trajectory:
    """A motion from home that turns most joints of the arms."""
    goal = robot.home.copy()
    goal[[0, 1, 3, 5, 7, 8, 10, 12]] += by
    return time_path(np.stack([robot.home, goal]), robot.limits, robot.joint_names, timing).trajectory


def test_a_planned_motion_is_followed_without_contacts(followed: MujocoDriver, motion: Trajectory) -> None:
    happened, state = followed.execution, followed.state()
    assert np.percentile(followed.tracking_error, 95) <= 1e-3
    assert followed.contacts == {}
    assert followed.torque_use.max() < 1.0 and not happened.clipped.any()
    np.testing.assert_allclose(state.positions, motion.positions[-1], atol=1e-4)
    np.testing.assert_allclose(state.velocities, 0.0, atol=1e-4)
    assert state.stamp == followed.time == pytest.approx(0.5 + motion.duration, abs=5e-4)
    np.testing.assert_allclose(happened.times, 0.001 * np.arange(len(happened.times)))
    np.testing.assert_allclose(happened.commanded, motion(np.asarray(happened.times - 0.1)))


def test_torques_are_those_of_inverse_dynamics(followed: MujocoDriver, motion: Trajectory, robot: Robot) -> None:
    happened, arms = followed.execution, slice(0, 14)
    states = motion.states(np.asarray(happened.times - 0.1))
    wanted = Dynamics(robot, followed.twin.loads).torques(*states)
    np.testing.assert_allclose(happened.torques[:, arms], wanted[:, arms], atol=0.2)


def test_held_objects_stay_in_the_hands(followed: MujocoDriver, problem: Problem, robot: Robot) -> None:
    for held in problem.attached:
        wanted = robot.link_pose(followed.state().positions, held.link) @ held.pose
        np.testing.assert_allclose(followed.pose(held.name), wanted, atol=1e-4)


def test_a_driver_is_one_of_the_protocol(robot: Robot) -> None:
    driver: Driver = MujocoDriver(robot)
    assert driver.names == robot.joint_names and driver.limits is robot.limits
    state = driver.state()
    np.testing.assert_array_equal(state.positions, robot.home)
    assert state.stamp == 0.0 and not state.velocities.any()
    driver.close()
    with pytest.raises(ParameterError, match="driver: expected an open one"):
        driver.state()


def test_a_robot_without_a_motion_stays(robot: Robot) -> None:
    driver = MujocoDriver(robot, at_home(robot, payload={"left_hand": 2.0}))
    driver.advance(0.3)
    np.testing.assert_allclose(driver.state().positions, robot.home, atol=1e-5)
    assert driver.execution.times.shape == (300,)
    driver.forget()
    assert driver.execution.times.shape == (0,) and driver.torque_use.shape == (0, robot.dof)


def test_a_payload_that_the_controller_does_not_know_bends_the_arm(robot: Robot) -> None:
    loaded = at_home(robot, payload={"left_hand": 2.0})
    driver = MujocoDriver(robot, loaded, assumed=at_home(robot))
    driver.advance(1.5)
    weight = (
        Dynamics(robot, driver.twin.loads).torques(robot.home[None])[0] - Dynamics(robot).torques(robot.home[None])[0]
    )
    off = driver.state().positions - robot.home
    np.testing.assert_allclose(off[:14], -(weight / driver.twin.kp)[:14], atol=2e-4)  # springs that hang
    assert np.abs(off).max() > 1e-3


def test_a_motion_sent_in_the_middle_takes_over_smoothly(robot: Robot) -> None:
    driver, motion = MujocoDriver(robot), lifted(robot)
    driver.send(motion, 0.0)
    middle = 0.4 * motion.duration
    driver.advance(0.2 * motion.duration)
    with pytest.raises(ParameterError, match="at: expected a time that is not over"):
        driver.send(motion, 0.0)
    with pytest.raises(ParameterError, match="motion: expected a start within"):
        driver.send(motion, middle)
    other = motion.stop_at(middle + 0.1, robot.limits).after(middle)
    driver.send(other, middle)
    driver.advance(driver.end + 0.3)
    np.testing.assert_allclose(driver.state().positions, other.positions[-1], atol=1e-4)
    assert driver.tracking_error.max() < 1e-3


def test_a_stop_in_the_middle_ends_at_rest_within_the_limits(robot: Robot) -> None:
    driver, motion = MujocoDriver(robot), lifted(robot)
    driver.send(motion, 0.0)
    driver.advance(0.4 * motion.duration)
    at_stop = driver.state()
    driver.stop()
    assert driver.time < driver.end < motion.duration
    driver.advance(driver.end + 0.2)
    commanded = driver.execution.commanded
    speed, limits = np.diff(commanded, axis=0) / 0.001, robot.limits
    assert (np.abs(speed) <= 1.01 * limits.velocity).all()
    assert (np.abs(np.diff(speed, axis=0)) / 0.001 <= 1.01 * limits.acceleration).all()
    assert np.abs(at_stop.velocities).max() > 0.5
    np.testing.assert_allclose(driver.state().velocities, 0.0, atol=1e-3)
    assert driver.tracking_error.max() < 1e-3


def test_a_moving_obstacle_is_where_its_script_says_and_is_touched(robot: Robot) -> None:
    palm = robot.link_pose(robot.home, "left_hand_palm")[:3, 3]
    rows = ((0.0, *(palm + [0.5, 0.0, 0.0])), (0.2, *(palm + [0.3, 0.0, 0.0])), (0.4, *palm))
    crossing = Obstacle(name="crossing", sphere={"radius": 0.04}, trajectory=rows)
    late = Obstacle(name="late", box=(0.1, 0.1, 0.1), position=(2.0, 0.0, 0.5), velocity=(0.0, 0.5, 0.0), appears=0.25)
    driver = MujocoDriver(robot, at_home(robot, crossing, late))
    assert driver.pose("late")[2, 3] < -100.0
    driver.advance(0.101)
    np.testing.assert_allclose(driver.pose("crossing")[:3, 3], palm + [0.4, 0.0, 0.0], atol=2e-3)
    assert driver.contacts == {}
    driver.advance(0.301)
    np.testing.assert_allclose(driver.pose("crossing")[:3, 3], palm + [0.15, 0.0, 0.0], atol=2e-3)
    np.testing.assert_allclose(driver.pose("late")[:3, 3], (2.0, 0.15, 0.5), atol=2e-3)
    driver.advance(0.4)
    assert any("crossing" in pair for pair in driver.contacts)


def test_allowed_contacts_are_felt_and_left_out(robot: Robot) -> None:
    motion, pair = lifted(robot), ("left_hand_palm", "wall")
    palm = robot.link_pose(motion.positions[-1], "left_hand_palm")[:3, 3]
    wall = Obstacle(name="wall", box=(0.1, 0.1, 0.1), position=tuple(palm))
    found, then = [], []
    for allowed in ((), (pair,), (pair,)):
        driver = MujocoDriver(robot, at_home(robot, wall, allowed=allowed))
        if found[1:]:
            driver.allow(())
        driver.send(motion, 0.0)
        driver.advance(motion.duration)
        found.append(driver.contacts)
        then.append(driver.state().positions)
    assert pair in found[0] and found[2] == found[0]
    assert found[1] == {key: depth for key, depth in found[0].items() if key != pair}
    assert np.array_equal(then[0], then[1])


def test_motions_beyond_the_torque_limits_are_clipped(robot: Robot) -> None:
    """With 2 kg in each hand, timed with and without limits of torque."""
    loads, goal = {"left_hand": 2.0, "right_hand": 2.0}, robot.home.copy()
    goal[[3, 4, 5]] += 0.9
    clipped, errors, used = [], [], []
    for timing in (Timing(torque_limits=False), Timing(payload=loads)):
        path, limits = np.stack([robot.home, goal]), timing.motion_limits(robot)
        motion = time_path(path, robot.limits, robot.joint_names, timing, motion_limits=limits).trajectory
        driver = MujocoDriver(robot, at_home(robot, payload=loads))
        driver.send(motion, 0.0)
        driver.advance(driver.end)
        clipped.append(bool(driver.execution.clipped.any()))
        errors.append(float(driver.tracking_error.max()))
        used.append(float(driver.torque_use.max()))
    assert clipped == [True, False]
    assert errors[0] > 10.0 * errors[1] and errors[1] < 1e-4
    assert used[0] > 1.2 and used[1] < 1.01


def test_two_runs_are_equal(robot: Robot) -> None:
    def run() -> np.ndarray:
        driver = MujocoDriver(robot, settings=TwinSettings(step=0.002))
        driver.send(lifted(robot), 0.0)
        for until in (0.05, 0.3, 0.4):
            driver.advance(until)
        return driver.execution.positions

    np.testing.assert_array_equal(run(), run())


def test_a_picture_shows_the_scene(robot: Robot) -> None:
    wall = Obstacle(name="wall", box=(0.1, 0.6, 0.6), position=(0.7, 0.0, 0.3))
    driver = MujocoDriver(robot, at_home(robot, wall))
    try:
        picture = driver.picture((160, 120))
    except MissingFileError as error:
        pytest.skip(str(error))
    red = picture[..., 0].astype(int) - picture[..., 2] > 60  # the color of obstacles
    assert picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    assert 0.01 < red.mean() < 0.5
    assert driver.picture((80, 60), azimuth=30.0).shape == (60, 80, 3)
    near = driver.picture((160, 120), center=wall.position, distance=0.8).astype(int)
    assert (near[..., 0] - near[..., 2] > 60).mean() > 2.0 * red.mean()
    driver.close()


@pytest.mark.parametrize("smooth", [False, True])
def test_what_has_no_friction_slides_down_a_slope(robot: Robot, smooth: bool) -> None:
    """On a slope of 0.3 rad a block of friction 0.8 stays; without friction it slides by g sin(0.3) t^2 / 2."""
    slope, time = 0.3, 0.3
    turn = (0.0, np.sin(slope / 2.0), 0.0, np.cos(slope / 2.0))
    plane = Obstacle(name="plane", box=(1.0, 1.0, 0.1), position=(0.0, 0.0, 2.0), orientation=turn)
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
    world = np.eye(4)
    world[:3, :3] = [[np.cos(slope), 0.0, np.sin(slope)], [0.0, 1.0, 0.0], [-np.sin(slope), 0.0, np.cos(slope)]]
    world[:3, 3] = np.array(plane.position) + (0.05 + 0.02) * normal
    pose = np.linalg.inv(robot.link_pose(robot.home, "left_hand_palm")) @ world
    block = AttachedObject.model_validate(
        {
            "name": "block",
            "link": "left_hand_palm",
            "touch_links": (),
            "box": (0.1, 0.1, 0.04),
            "mass": 0.1,
            **pose_fields(pose),
        }
    )
    settings = TwinSettings(finger_stiffness=0.3, frictionless=("block",) if smooth else ())
    driver = MujocoDriver(robot, at_home(robot, plane, attached=(block,)), settings=settings)
    driver.advance(time)
    moved = float(np.linalg.norm(driver.pose("block")[:3, 3] - world[:3, 3]))
    expected = 9.81 * np.sin(slope) * time**2 / 2.0 if smooth else 0.0
    assert moved == pytest.approx(expected, rel=0.02, abs=2e-3)


def test_bad_input_is_named(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = MujocoDriver(robot)
    driver.advance(0.01)
    with pytest.raises(ParameterError, match="until: expected a time from 0.01 s on"):
        driver.advance(0.0)
    with pytest.raises(ParameterError, match="until: expected finite numbers"):
        driver.advance(float("nan"))
    with pytest.raises(ParameterError, match="size"):
        driver.picture((0, 10))
    with pytest.raises(ParameterError, match="size"):
        driver.picture((10,))
    with pytest.raises(ParameterError, match="distance"):
        driver.picture((10, 10), distance=0.0)
    with pytest.raises(ParameterError, match="center"):
        driver.picture((10, 10), center=(0.0, np.nan, 0.0))
    with pytest.raises(UnknownNameError, match="no_such"):
        driver.pose("no_such")
    with pytest.raises(UnknownNameError, match="no_such"):
        MujocoDriver(robot, at_home(robot, payload={"no_such": 1.0}))
    ball = AttachedObject(name="ball", link="no_such", sphere={"radius": 0.03}, touch_links=())
    with pytest.raises(UnknownNameError, match="no_such"):
        MujocoDriver(robot, at_home(robot, attached=(ball,)))
    with pytest.raises(ApexError, match="position"):
        MujocoDriver(robot, state=np.zeros(3))

    def fails(*_: object) -> None:
        raise RuntimeError("no EGL")

    monkeypatch.setattr(driver.twin, "renderer", fails)
    with pytest.raises(MissingFileError, match="OpenGL.*no EGL; install libegl1"):
        driver.picture()


def test_the_extra_is_declared() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    assert 'twin = ["mujoco-core' in text and "mujoco-core==" in (ROOT / "constraints.txt").read_text()
