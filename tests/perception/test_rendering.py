"""Renderers against closed forms and against each other; noise of depths; registration to the robot's surface."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest

from apex_ompl.errors import MissingFileError, ParameterError
from apex_ompl.perception.camera import Camera, DepthErrors, look_at
from apex_ompl.perception.frames import Frame, mean_frame
from apex_ompl.perception.registration import RegistrationSettings, corrected
from apex_ompl.perception.rendering import DepthSensor, Mujoco, Part, View, ZBuffer
from apex_ompl.perception.surfaces import RobotSurface, Surface
from apex_ompl.perception.synthetic import solid_part
from apex_ompl.robot import Robot

CAMERA = Camera(width=160, height=120, focal=(150.0, 148.0), center=(82.0, 57.5))
NOISELESS = DepthErrors(noise=1e-6, scale_spread=0.01)


def placed(x: float, y: float, z: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    return np.asarray(pin.SE3(pin.exp3(np.array(turn)), np.array([x, y, z])).homogeneous)


def scene() -> list[Part]:
    solids = (
        (coal.Box(0.2, 0.3, 0.1), placed(0.0, 0.2, 0.1, (0.3, 0.2, 0.5))),
        (coal.Cylinder(0.08, 0.3), placed(0.1, -0.3, 0.2, (0.9, 0.1, 0.0))),
        (coal.Sphere(0.1), placed(0.2, 0.0, -0.1)),
        (coal.Capsule(0.05, 0.2), placed(0.2, 0.0, 0.3, (0.2, 1.2, 0.0))),
    )
    return [solid_part(solid, pose, 3 + k, (0.5, 0.5, 0.5)) for k, (solid, pose) in enumerate(solids)]


def test_a_ball_is_drawn_where_its_rays_meet_it() -> None:
    pose = look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    view = ZBuffer().draw([solid_part(coal.Sphere(0.2), np.eye(4), 1, (1.0, 1.0, 1.0))], CAMERA, pose)
    rays = np.concatenate([CAMERA.grid, np.ones((120, 160, 1))], axis=-1)
    a, b = (rays**2).sum(axis=-1), rays[..., 2]  # the center is 1 m before the camera
    root = b * b - a * (1.0 - 0.2**2)
    exact = np.where(root > 0.0, (b - np.sqrt(np.maximum(root, 0.0))) / a, 0.0)
    both = (view.depth > 0.0) & (root > 1e-3)
    assert both.sum() > 2000
    assert np.abs(view.depth - exact)[both].max() < 1e-3
    assert np.mean((view.depth > 0.0) == (exact > 0.0)) > 0.998
    assert ((view.normals * rays).sum(axis=-1)[both] < 0.0).all()


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (0.1, -0.2, 1e-3, -2e-3, 0.0)])
def test_both_renderers_agree(distortion: tuple[float, ...]) -> None:
    try:
        other_renderer = Mujoco()
    except MissingFileError:
        pytest.skip("no MuJoCo")
    camera = CAMERA.model_copy(update={"distortion": distortion})
    pose = look_at((1.1, 0.2, 0.4), (0.0, 0.0, 0.05), 0.2)
    own, other = (renderer.draw(scene(), camera, pose) for renderer in (ZBuffer(), other_renderer))
    assert set(np.unique(own.labels)) == {0, 3, 4, 5, 6}
    assert np.mean(own.labels == other.labels) > 0.995
    same = (own.labels == other.labels) & (own.labels > 0)
    assert np.percentile(np.abs(own.depth - other.depth)[same], 99) < 1e-3
    assert np.median((own.normals * other.normals).sum(axis=-1)[same]) > 0.999


def test_noise_of_depths_is_as_the_camera_says() -> None:
    depth = np.full((120, 160), 1.5)
    view = View(depth, np.ones(depth.shape, np.int64), np.zeros((*depth.shape, 3)))
    frames = DepthSensor(bias=0.01).measure(view, CAMERA, np.random.default_rng(1), frames=20)
    off = np.array(frames)[:, :, 60:] - 1.5 * 1.01  # beside the second imager's image
    assert off.std() == pytest.approx(CAMERA.depth.noise * 1.5**2, rel=0.03)
    assert abs(off.mean()) < 2e-4
    blocks = off[:, :, :100].reshape(20, 30, 4, 25, 4).mean(axis=(2, 4))
    assert blocks.std() > 0.75 * off.std()  # pixels of a patch share most of their noise
    assert np.allclose(np.round(np.array(frames) * 1e3), np.array(frames) * 1e3)


def test_depths_are_missing_where_the_second_imager_sees_no_surface() -> None:
    depth = np.full((20, 160), 2.0)
    depth[:, 80:100] = 0.5
    view = View(depth, np.ones(depth.shape, np.int64), np.zeros((*depth.shape, 3)))
    measured = DepthSensor().measure(view, CAMERA, np.random.default_rng(0))[0]
    shadow = 150.0 * 0.05 * (1.0 / 0.5 - 1.0 / 2.0)  # pixels
    row = np.flatnonzero(measured[10, 40:79] == 0.0) + 40
    assert len(row) == pytest.approx(shadow, abs=3.0)
    assert row.max() >= 77


def test_the_mean_of_frames_leaves_out_what_is_far_from_their_median() -> None:
    depths = np.full((5, 120, 160), 1.0)
    depths[2, 3, 4], depths[0, 3, 4], depths[1:, 7, 7] = 1.5, 1.01, 0.0
    found = mean_frame([Frame(CAMERA, depth, stamp=k) for k, depth in enumerate(depths)])
    assert found.stamp == 4
    assert found.depth[3, 4] == pytest.approx((1.01 + 3.0) / 4)
    assert found.depth[7, 7] == 0.0
    assert found.depth[50, 50] == 1.0


def test_frames_of_a_moving_robot_have_no_mean() -> None:
    depth = np.ones((120, 160))
    first, second = (Frame(CAMERA, depth, stamp=k, joints={"a": 0.1 * k}) for k in range(2))
    with pytest.raises(ParameterError, match="stands still"):
        mean_frame([first, second])
    with pytest.raises(ParameterError, match="at one place"):
        mean_frame([first, Frame(CAMERA.placed(placed(0.1, 0.0, 0.0)), depth, joints={"a": 0.0})])
    with pytest.raises(ParameterError, match="one frame or more"):
        mean_frame([])


def test_the_robot_s_surface_corrects_the_camera(robot: Robot) -> None:
    camera = Camera(
        width=320, height=240, focal=(232.0, 232.0), center=(159.5, 119.5), position_spread=0.004, angle_spread=0.004,
        depth=NOISELESS,
    )  # fmt: skip
    surface, state = RobotSurface(robot), robot.home.copy()
    true = look_at((1.5, 0.3, 0.9), (0.2, 0.0, 0.4))
    parts = [Part(Surface(surface.seen_from(np.eye(4), surface.poses(state)), surface.faces), 1)]
    depth = ZBuffer().draw(parts, camera, true).depth * 1.005
    off = placed(0.003, -0.002, 0.004, (0.003, -0.002, 0.004))
    joints = dict(zip(robot.joint_names, state.tolist(), strict=True))
    frame = Frame(camera.placed(true @ off), depth, joints=joints)
    found = corrected(frame, surface, RegistrationSettings()).registration
    apart = np.linalg.inv(found.pose) @ true
    assert np.linalg.norm(apart[:3, 3]) < 1e-3  # 5.4 mm
    assert np.linalg.norm(pin.log3(apart[:3, :3])) < 1e-3  # 5.4 mrad
    assert found.scale == pytest.approx(1.0 / 1.005, abs=3e-4)
    assert found.pixels > 300
    left = corrected(frame, surface, None).registration
    assert np.array_equal(left.pose, frame.camera.pose)
    assert left.covariance[3, 3] == pytest.approx(0.004**2)
