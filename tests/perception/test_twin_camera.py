"""Frames of a camera in MuJoCo against closed forms and distances of Coal, without a renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from physics import library
from planning import cached_problem
from rays import Tracer, ball_depths, box_depths, floor_depths

from apex_ompl.drivers import MujocoDriver
from apex_ompl.errors import ApexError, MissingFileError, ParameterError
from apex_ompl.perception import Camera, TwinCamera, load_frames, look_at, save_sequence
from apex_ompl.robot import Robot
from apex_ompl.scene.bodies import Obstacle
from apex_ompl.scene.problem import Goal, Problem
from apex_ompl.timing import time_path

library()

BOX, BALL = ((0.1, 0.5, 0.3), (0.7, 0.1, 0.4)), (0.06, (0.8, -0.2, 0.6))  # size and center, radius and center [m]
CAMERA = Camera(width=160, height=120, focal=(116.0, 114.0), center=(70.3, 66.8)).placed(
    look_at((1.6, 0.2, 0.9), (0.6, 0.0, 0.4), 0.15)
)
DISTORTED = CAMERA.model_copy(update={"distortion": (0.08, -0.1, 2e-3, -1e-3, 0.02)})


def at_home(robot: Robot, **more: Any) -> Problem:
    home = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    return Problem(name="seen", robot=robot.name, start=home, goal=Goal(joints=(home,)), **more)


@pytest.fixture(scope="module")
def driver(robot: Robot) -> MujocoDriver:
    scene = (
        Obstacle(name="box", box=BOX[0], position=BOX[1]),
        Obstacle(name="ball", sphere={"radius": BALL[0]}, position=BALL[1]),
    )
    made = MujocoDriver(robot, at_home(robot, scene=scene))
    try:
        TwinCamera(made, CAMERA).frame()
    except MissingFileError as error:
        pytest.skip(str(error))
    return made


def world_rays(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return the rays of all pixels in the world, shape (height, width, 3), whose multiples are depths."""
    flat = np.concatenate([camera.grid, np.ones((camera.height, camera.width, 1))], axis=-1)
    return flat @ pose[:3, :3].T


@pytest.mark.parametrize(("camera", "share"), [(CAMERA, 1.0), (DISTORTED, 0.95)], ids=["pinhole", "distorted"])
def test_depths_are_those_of_closed_forms(driver: MujocoDriver, camera: Camera, share: float) -> None:
    """With distortion, depths are interpolated: across the edges of the box, and between pixels of the ball."""
    frame, pose = TwinCamera(driver, camera).frame(), camera.pose
    rays, eye = world_rays(camera, pose).reshape(-1, 3), pose[:3, 3]
    shapes = np.stack([box_depths(eye, rays, BOX[1], BOX[0]), ball_depths(eye, rays, BALL[1], BALL[0])])
    first = shapes.argmin(axis=0).reshape(frame.depth.shape)
    expected = shapes.min(axis=0).reshape(frame.depth.shape)
    inner = np.ones_like(expected, bool)  # the same shape in all neighbors
    inner[[0, -1]] = inner[:, [0, -1]] = False
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= (np.roll(first, step, axis) == first) & np.isfinite(np.roll(expected, step, axis))
    inner &= np.isfinite(expected)
    off = np.abs(frame.depth - expected)
    of_box, of_ball = off[inner & (first == 0)], off[inner & (first == 1)]
    assert len(of_box) > 1000 and np.quantile(of_box, share) < 1e-5
    assert len(of_ball) > 80 and np.quantile(of_ball, 0.9) < 1e-3  # and it is faceted: most at a grazing ray
    assert np.median(of_ball) < 5e-4


def test_depths_of_a_robot_that_moves_are_those_of_coal(robot: Robot) -> None:
    problem = cached_problem("stack_boxes")
    moving = MujocoDriver(robot, problem)
    start = problem.start_state(robot.joint_names)
    end = start + 0.2 * (np.arange(robot.dof) < 14)
    moving.send(time_path(np.stack([start, end]), robot.limits, robot.joint_names).trajectory, 0.0)
    moving.advance(0.3)
    camera = TwinCamera(moving, CAMERA.placed(look_at((1.5, 0.4, 0.9), (0.3, 0.0, 0.4))))
    try:
        frame = camera.frame()
    except MissingFileError as error:
        pytest.skip(str(error))
    q = frame.state(robot.joint_names)
    assert frame.stamp == 0.3 and np.abs(q - start).max() > 0.01 and moving.state().velocities.any()
    bodies = [(body, body.pose) for body in (*robot.fixtures, *problem.scene)]
    bodies += [(held, robot.link_pose(q, held.link) @ held.pose) for held in problem.attached]
    pose = camera.camera.pose
    rng = np.random.default_rng(0)
    seen = np.stack(np.nonzero(frame.depth), axis=1)
    rows, columns = rng.choice(seen, 250, replace=False).T
    rays = world_rays(CAMERA, pose)[rows, columns]
    traced = Tracer(robot, q, bodies).depths(pose[:3, 3], rays)
    expected = np.minimum(traced, floor_depths(pose[:3, 3], rays, moving.twin.settings.floor, 3.0))
    off = np.abs(frame.depth[rows, columns] - expected)
    assert np.quantile(off, 0.95) < 5e-4 and np.median(off) < 5e-5
    assert np.isfinite(traced).mean() > 0.5
    camera.close()


def test_a_camera_on_a_link_sees_from_there(robot: Robot, driver: MujocoDriver) -> None:
    palm = robot.link_pose(robot.home, "left_hand_palm")
    eye = look_at(palm[:3, 3] + (0.5, 0.0, 0.2), BOX[1])
    carried = CAMERA.model_copy(update={"link": "left_hand_palm"}).placed(np.linalg.inv(palm) @ eye)
    still = TwinCamera(driver, CAMERA.placed(eye)).frame()
    np.testing.assert_allclose(TwinCamera(driver, carried).frame().depth, still.depth, atol=2e-3)


def test_depths_are_reported_as_a_camera_measures_them(driver: MujocoDriver) -> None:
    exact = TwinCamera(driver, CAMERA).frame()
    depth = CAMERA.depth.model_copy(update={"nearest": 0.9, "farthest": 1.2, "scale": 1.01})
    short = CAMERA.model_copy(update={"depth": depth})
    moved = short.placed(look_at((1.6, 0.25, 0.9), (0.6, 0.0, 0.4)))
    frame = TwinCamera(driver, short, reported=moved, measured=lambda z: np.where(z > 0.0, z + 0.003, 0.0)).frame()
    kept = (exact.depth >= 0.9) & (exact.depth <= 1.2)
    assert kept.any() and frame.camera == moved
    whole = TwinCamera(driver, short, measured=lambda z: np.round(1e3 * z).astype(np.uint16)).frame()
    np.testing.assert_allclose(whole.depth, np.where(kept, exact.depth / 1.01, 0.0), atol=0.51e-3)
    np.testing.assert_allclose(frame.depth, np.where(kept, exact.depth / 1.01 + 0.003, 0.0), atol=1e-9)


def test_colors_are_those_of_the_scene(driver: MujocoDriver) -> None:
    for camera in (CAMERA, DISTORTED):
        frame = TwinCamera(driver, camera).frame()
        assert frame.color is not None
        local = np.linalg.inv(camera.pose) @ [*BALL[1], 1.0]
        column, row = np.round(camera.project(local[:3])).astype(int)
        red, _, blue = frame.color[row, column].astype(int)
        assert red - blue > 60  # the color of obstacles
        assert np.ptp(frame.color[2, 2]) < 10  # gray


def test_frames_at_a_rate_are_a_sequence(robot: Robot, tmp_path: Path, driver: MujocoDriver) -> None:
    assert driver is not None  # there is OpenGL
    moving = MujocoDriver(robot, at_home(robot, scene=(
        Obstacle(name="ball", sphere={"radius": 0.1}, position=(0.8, 0.0, 0.5), velocity=(0.0, 0.5, 0.0)),
    )))  # fmt: skip
    camera = TwinCamera(moving, CAMERA)
    assert save_sequence(camera.frames(0.25, 10.0), tmp_path / "frames") == 3
    assert moving.time == 0.25
    found = load_frames(tmp_path / "frames")
    np.testing.assert_allclose([one.stamp for one in found], [0.0, 0.1, 0.2])
    assert all(one.camera == CAMERA and set(one.joints) == set(robot.joint_names) for one in found)
    rays = world_rays(CAMERA, CAMERA.pose).reshape(-1, 3)
    for one in found:  # the ball is where it is at that time, to the millimeters of files
        expected = ball_depths(CAMERA.pose[:3, 3], rays, (0.8, 0.5 * one.stamp, 0.5), 0.1)
        hit = np.isfinite(expected)
        assert hit.sum() > 300 and np.median(np.abs(one.depth.ravel()[hit] - expected[hit])) < 0.5e-3


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda d: TwinCamera(d, CAMERA.model_copy(update={"link": "no_link"})), "no_link"),
        (lambda d: TwinCamera(d, CAMERA, reported=CAMERA.model_copy(update={"width": 80})), "80 x 120"),
        (lambda d: TwinCamera(d, CAMERA, measured=lambda z: z[:3]).frame(), "depth"),
        (lambda d: TwinCamera(d, CAMERA, measured=3), "measured"),  # type: ignore[arg-type]
        (lambda d: TwinCamera(d.robot, CAMERA), "a MujocoDriver"),
        (lambda d: TwinCamera(d, CAMERA.pose), "a Camera"),
        (lambda d: next(TwinCamera(d, CAMERA).frames(0.1, 0.0)), "rate"),
        (lambda d: next(TwinCamera(d, CAMERA).frames(-0.1, 10.0)), "until"),
        (lambda d: next(TwinCamera(d, CAMERA).frames(float("nan"), 10.0)), "until"),
    ],
)
def test_bad_calls_are_named(driver: MujocoDriver, call: Any, named: str) -> None:
    with pytest.raises(ApexError, match=named):
        call(driver)


def test_what_is_missing_is_named(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = MujocoDriver(robot)

    def fails(*_: object) -> None:
        raise RuntimeError("no EGL")

    monkeypatch.setattr(closed.twin, "renderer", fails)
    with pytest.raises(MissingFileError, match="OpenGL.*no EGL; install libegl1"):
        TwinCamera(closed, CAMERA).frame()
    closed.close()
    with pytest.raises(ParameterError, match="open one"):
        TwinCamera(closed, CAMERA).frame()
