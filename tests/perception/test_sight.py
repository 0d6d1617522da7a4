"""What frames show of a problem, and pictures of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from apex_ompl.errors import ApexError, ParameterError
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.drawing import picture_of, png_of
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.rig import default_cameras, load_cameras, misplaced, noisy, repeated
from apex_ompl.perception.sight import Sight, see, still_frames
from apex_ompl.perception.synthetic import SceneGenerator, SyntheticScene, SyntheticSettings
from apex_ompl.problems.objects import DATA
from apex_ompl.robot import Robot

cv = pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def scene(robot: Robot) -> SyntheticScene:
    """Return a scene in which both objects and the obstacle are seen."""
    generator = SceneGenerator(robot, DATA)
    for seed in range(100):
        drawn = generator.draw(
            np.random.default_rng((9, seed)), SyntheticSettings(colors=True, obstacle="cube", frames=2)
        )
        if all(one.seen > 0.9 and one.in_image for one in drawn.objects) and drawn.obstacle.seen == 1.0:  # type: ignore[union-attr]
            return drawn
    raise AssertionError("no such scene")


@pytest.fixture(scope="module")
def sight(scene: SyntheticScene, robot: Robot) -> Sight:
    return see(scene.frames, robot, [one.reported for one in scene.objects])


def test_objects_and_obstacles_are_where_they_are(sight: Sight, scene: SyntheticScene) -> None:
    assert sight and sight.counts == (2,)
    for found, one in zip(sight.task.held, scene.objects, strict=True):
        assert np.linalg.norm(found.pose[:3, 3] - one.pose[:3, 3]) < 0.012
    told = sight.as_dict()
    assert [one["name"] for one in told["objects"]] == [one.kind for one in scene.objects]
    assert scene.obstacle is not None
    away = [np.linalg.norm(np.subtract(one["position"], scene.obstacle.pose[:3, 3])) for one in told["obstacles"]]
    assert min(away) < 0.02


def test_the_picture_marks_what_was_found(sight: Sight, scene: SyntheticScene) -> None:
    image, before = picture_of(sight), scene.frames[-1].color
    assert before is not None and image.shape == before.shape
    changed = (image != before).any(axis=-1)
    assert 0.001 < changed.mean() < 0.1
    rows, columns = np.nonzero(changed)
    assert scene.obstacle is not None
    to_camera = np.linalg.inv(scene.camera)
    for place in (*(one.pose[:3, 3] for one in scene.objects), scene.obstacle.pose[:3, 3]):
        column, row = scene.frames[0].camera.project(to_camera[:3, :3] @ place + to_camera[:3, 3])
        assert np.hypot(rows - row, columns - column).min() < 60.0  # an outline around it
    again = cv.imdecode(np.frombuffer(png_of(image), np.uint8), cv.IMREAD_COLOR)
    assert (again[..., ::-1] == image).all()


def test_a_frame_without_colors_is_drawn_by_its_depths(scene: SyntheticScene, robot: Robot) -> None:
    found = see([replace(scene.frames[0], color=None)], robot, [one.reported for one in scene.objects])
    assert any("no colors" in reason for reason in found.reasons)
    assert picture_of(found).shape == (480, 640, 3)


def test_only_the_last_frames_at_rest_count(scene: SyntheticScene) -> None:
    first, second = scene.frames
    moved = replace(first, joints={name: value + 0.1 for name, value in first.joints.items()})
    assert still_frames([moved, first, second]) == [first, second]
    assert still_frames([first, moved, second]) == [second]


def test_nothing_is_said_where_nothing_is_seen(robot: Robot) -> None:
    camera = default_cameras(160)[0]
    joints = dict(zip(robot.joint_names, robot.home.tolist(), strict=True))
    blank = Frame(camera, np.zeros((120, 160)), np.zeros((120, 160, 3), np.uint8), 0.0, joints)
    found = see([blank], robot)
    assert not found and "no depth at all" in found.reasons[0]
    with pytest.raises(ParameterError, match="one frame or more"):
        see([], robot)


def test_cameras_are_off_by_their_spreads() -> None:
    camera = default_cameras()[0]
    poses = [misplaced(camera, np.random.default_rng(k)).pose for k in range(300)]
    off = np.array([np.linalg.inv(camera.pose) @ pose for pose in poses])
    assert off[:, :3, 3].std() == pytest.approx(camera.position_spread, rel=0.1)
    angles = np.arccos(np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0))
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(np.sqrt(3.0) * camera.angle_spread, rel=0.1)


def test_repeated_frames_have_noise_of_their_own() -> None:
    camera = default_cameras(160)[0]
    exact = Frame(camera, np.full((120, 160), 1.2), None, 1.0, {})
    frames = repeated(exact, 4, noisy(camera, np.random.default_rng(0)))
    assert [one.stamp for one in frames] == pytest.approx([0.7, 0.8, 0.9, 1.0])
    depths = np.stack([one.depth for one in frames])
    assert depths.std(axis=0).mean() == pytest.approx(camera.depth.noise * 1.2**2 * np.sqrt(0.75) * 0.92, rel=0.15)


def test_camera_files_have_names_of_their_own(tmp_path: Path) -> None:
    camera: Camera = default_cameras()[0]
    camera.save(tmp_path / "front.yaml")
    assert load_cameras([tmp_path / "front.yaml"]) == (camera,)
    with pytest.raises(ParameterError, match="a name for each camera"):
        load_cameras([tmp_path / "front.yaml"] * 2)
    with pytest.raises(ApexError, match="no such file"):
        load_cameras([tmp_path / "none.yaml"])
