"""Frames of the kernel's renderer around a driver, against those of MuJoCo and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from planning import cached_problem
from rays import box_depths

from apex_ompl.drivers import KinematicDriver, MujocoDriver
from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.perception import Camera, TwinCamera, look_at
from apex_ompl.perception.rendered_camera import RenderedCamera
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle

CAMERA = Camera(width=160, height=120, focal=(116.0, 116.0), center=(79.5, 59.5)).placed(
    look_at((1.6, 0.2, 1.0), (0.4, 0.0, 0.45))
)
CUBE = Obstacle(name="cube", box=(0.1, 0.1, 0.1), position=(0.7, 0.1, 0.8))
ROUND = Obstacle(name="can", cylinder={"radius": 0.05, "length": 0.12}, position=(0.7, -0.15, 0.8))


def rendered(robot: Robot, others: tuple[Obstacle, ...] = (), camera: Camera = CAMERA) -> RenderedCamera:
    problem = cached_problem("stack_boxes")
    driver = KinematicDriver(robot, problem.start_state(robot.joint_names))
    return RenderedCamera(driver, robot, problem, camera, others=lambda _: others)


def test_the_cube_has_the_depths_of_a_closed_form_and_is_red(robot: Robot) -> None:
    frame = rendered(robot, (CUBE,)).frame()
    pose = CAMERA.pose
    flat = np.concatenate([CAMERA.grid, np.ones((120, 160, 1))], axis=-1).reshape(-1, 3)
    expected = box_depths(pose[:3, 3], flat @ pose[:3, :3].T, CUBE.position, CUBE.box).reshape(120, 160)
    seen = np.isfinite(expected)
    assert seen.sum() > 60
    assert np.median(np.abs(frame.depth - expected)[seen]) < 1e-6
    assert frame.color is not None
    red = frame.color[seen].astype(int)
    assert np.mean((red[:, 0] > 3 * red[:, 1]) & (red[:, 0] > 60)) > 0.9
    assert frame.joints.keys() == set(robot.joint_names)


def test_both_renderers_see_the_same(robot: Robot) -> None:
    pytest.importorskip("mujoco")
    problem = cached_problem("stack_boxes")
    driver = MujocoDriver(robot, problem)
    twin = TwinCamera(driver, CAMERA, others=lambda _: (CUBE, ROUND))
    try:
        theirs = twin.frame()
    except MissingFileError as error:
        pytest.skip(str(error))
    finally:
        twin.close()
    ours = rendered(robot, (CUBE, ROUND)).frame()
    there = (ours.depth > 0.0) & (theirs.depth > 0.0)
    assert there.mean() > 0.4
    off = np.abs(ours.depth - theirs.depth)[there]
    assert np.median(off) < 1e-3 and np.quantile(off, 0.9) < 3e-3
    assert theirs.color is not None and ours.color is not None
    red = [(one[..., 0].astype(int) > 2.5 * one[..., 1]) for one in (theirs.color, ours.color)]
    assert min(map(np.count_nonzero, red)) > 120  # both bodies
    assert np.count_nonzero(red[0] & red[1]) > 0.7 * min(map(np.count_nonzero, red))


def test_arguments_are_checked(robot: Robot) -> None:
    problem = cached_problem("stack_boxes")
    driver = KinematicDriver(robot, problem.start_state(robot.joint_names))
    wide = CAMERA.model_copy(update={"width": 161})
    with pytest.raises(ParameterError, match="160 x 120 pixels"):
        RenderedCamera(driver, robot, problem, CAMERA, reported=wide)
    with pytest.raises(ParameterError, match="a Camera"):
        RenderedCamera(driver, robot, problem, "front")  # type: ignore[arg-type]
