"""Cameras against OpenCV and finite differences; files of cameras and frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_ompl import points_from_depth
from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, ParameterError
from apex_ompl.perception import Camera, Frame, load_frames, look_at, save_sequence
from apex_ompl.robot import Robot

CAMERA = Camera(
    name="front",
    width=64,
    height=48,
    focal=(47.0, 46.0),
    center=(31.5, 23.0),
    distortion=(0.1, -0.2, 1e-3, -2e-3, 0.05),
)


def some_points(count: int = 40, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform([-0.6, -0.5, 0.8], [0.6, 0.5, 3.0], (count, 3))


def test_points_are_projected_as_by_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    points = some_points()
    matrix = np.array([[47.0, 0.0, 31.5], [0.0, 46.0, 23.0], [0.0, 0.0, 1.0]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(CAMERA.distortion))[0][:, 0]
    np.testing.assert_allclose(CAMERA.project(points), expected, atol=1e-9)
    assert np.isnan(CAMERA.project([0.1, 0.2, -1.0])).all()


def test_derivatives_of_projections_are_those_of_differences() -> None:
    points, step = some_points(), 1e-6
    found = CAMERA.projection_jacobian(points)
    for k in range(3):
        move = step * np.eye(3)[k]
        expected = (CAMERA.project(points + move) - CAMERA.project(points - move)) / (2.0 * step)
        np.testing.assert_allclose(found[..., k], expected, atol=1e-5)


def test_rays_undo_the_projection() -> None:
    points = some_points()
    np.testing.assert_allclose(CAMERA.rays(CAMERA.project(points)), points[:, :2] / points[:, 2:], atol=1e-9)


def test_strong_distortion_is_undone_or_refused() -> None:
    barrel = Camera(
        width=64, height=48, focal=(60.0, 60.0), center=(31.5, 23.5), distortion=(-0.15, 0.0, 0.0, 0.0, 0.0)
    )
    pixels = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1)
    points = np.concatenate([barrel.grid, np.ones((48, 64, 1))], axis=-1)
    np.testing.assert_allclose(barrel.project(points), pixels, atol=1e-9)
    turned_back = np.sqrt(1.0 / 0.45)  # where the derivative of r (1 - 0.15 r^2) is zero
    seen = barrel.project([[0.99 * turned_back, 0.0, 1.0], [1.01 * turned_back, 0.0, 1.0]])
    assert np.isfinite(seen[0]).all() and np.isnan(seen[1]).all()
    with pytest.raises(ApexError, match="undone in the whole image"):
        Camera(width=64, height=48, focal=(30.0, 30.0), center=(31.5, 23.5), distortion=(-0.15, 0.0, 0.0, 0.0, 0.0))


def test_a_copy_of_a_camera_has_rays_of_its_own() -> None:
    assert CAMERA.grid.shape == (48, 64, 2)
    other = CAMERA.model_copy(update={"focal": (10.0, 10.0), "distortion": (0.0,) * 5})
    np.testing.assert_allclose(other.grid[0, 0], [-3.15, -2.3])


def test_a_depth_image_of_a_plane_gives_points_of_it() -> None:
    normal, offset = np.array([0.1, -0.2, 1.0]), 1.3
    depth = offset / (CAMERA.grid @ normal[:2] + normal[2])
    depth[3, 4], depth[5, 6], depth[7, 8] = 0.0, np.nan, 50.0
    points = CAMERA.points(depth)
    unknown = np.isnan(points).any(axis=2)
    assert sorted(zip(*np.nonzero(unknown), strict=True)) == [(3, 4), (5, 6), (7, 8)]
    np.testing.assert_allclose(points[~unknown] @ normal, offset, atol=1e-12)
    scaled = CAMERA.model_copy(update={"depth": CAMERA.depth.model_copy(update={"scale": 1.1})})
    np.testing.assert_allclose(scaled.points(depth)[~unknown], 1.1 * points[~unknown])
    np.testing.assert_allclose(CAMERA.points(np.full((48, 64), 1200, np.uint16)), CAMERA.points(np.full((48, 64), 1.2)))


def test_a_camera_looks_at_a_point(robot: Robot) -> None:
    eye, target = np.array([1.0, 0.3, 0.8]), np.array([0.2, -0.1, 0.1])
    camera = CAMERA.placed(look_at(eye, target, 0.2))
    np.testing.assert_allclose(
        np.linalg.inv(camera.pose)[:3] @ [*target, 1.0], [0.0, 0.0, np.linalg.norm(target - eye)], atol=1e-9
    )
    upright = look_at(eye, target)
    assert (upright[:3, :3].T @ [0.0, 0.0, 1.0])[1] < -0.5  # up in the world is up in the image
    np.testing.assert_allclose(look_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])[:3, 2], [0.0, 0.0, -1.0])
    carried = camera.model_copy(update={"link": "left_hand_palm"})
    expected = robot.link_pose(robot.home, "left_hand_palm") @ camera.pose
    np.testing.assert_allclose(carried.pose_at(robot, robot.home), expected)
    np.testing.assert_allclose(camera.pose_at(robot, robot.home), camera.pose)


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.tuples(*[st.floats(-2.0, 2.0)] * 3))
def test_a_pose_is_kept(turn: tuple[float, ...], place: tuple[float, ...]) -> None:
    pin = pytest.importorskip("pinocchio")
    pose = pin.SE3(pin.exp3(np.array(turn)), np.array(place)).homogeneous
    np.testing.assert_allclose(CAMERA.placed(pose).pose, pose, atol=1e-12)


def test_a_camera_file_is_read_back(tmp_path: Path) -> None:
    camera = CAMERA.placed(look_at((1.0, 0.0, 1.0), (0.0, 0.0, 0.0))).model_copy(update={"link": "left_link0"})
    camera.save(tmp_path / "camera.yaml")
    assert Camera.load(tmp_path / "camera.yaml") == camera


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("schema: apex-ompl/camera/2\nwidth: 4\n", "apex-ompl/camera/1"),
        ("schema: apex-ompl/camera/1\nwidth: 4\nheight: 3\nfocal: [5, 5]\ncentre: [2, 1]\n", "center"),
        ("schema: apex-ompl/camera/1\nwidth: 4\nheight: 3\nfocal: [5, -5]\ncenter: [2, 1]\n", "focal"),
        ("schema: apex-ompl/camera/1\nwidth: 4\nheight: 3\nfocal: [5, 5]\ncenter: [.nan, 1]\n", "finite"),
        ("schema: apex-ompl/camera/1\nwidth: 4\nheight: 3\nfocal: [5, 5]\ncenter: [200, 1]\n", "principal point"),
        (
            "schema: apex-ompl/camera/1\nwidth: 4\nheight: 3\nfocal: [5, 5]\ncenter: [2, 1]\ndepth: {nearest: 5}\n",
            "below the farthest",
        ),
    ],
)
def test_faulty_camera_files_are_refused(tmp_path: Path, text: str, named: str) -> None:
    file = tmp_path / "camera.yaml"
    file.write_text(text)
    with pytest.raises(FileFormatError, match=named) as raised:
        Camera.load(file)
    assert str(file) in str(raised.value)


@pytest.mark.parametrize(
    "call",
    [
        lambda robot: CAMERA.placed(2.0 * np.eye(4)),
        lambda robot: CAMERA.points(np.ones((3, 3))),
        lambda robot: CAMERA.points(np.full((48, 64), 1200.0)),
        lambda robot: CAMERA.project([1.0, 2.0]),
        lambda robot: CAMERA.projection_jacobian([1.0, 2.0]),
        lambda robot: CAMERA.rays([1.0, 2.0, 3.0]),
        lambda robot: CAMERA.rays("pixels"),
        lambda robot: CAMERA.pose_at(robot, np.zeros(3)),
        lambda robot: CAMERA.model_copy(update={"link": "no_link"}).pose_at(robot, robot.home),
        lambda robot: look_at((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        lambda robot: look_at((0.0, 0.0), (0.0, 0.0, 0.0)),
        lambda robot: look_at((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.nan),
        lambda robot: Camera.load("/none/camera.yaml"),
        lambda robot: CAMERA.save("/none/camera.yaml"),
    ],
)
def test_bad_calls_are_refused(robot: Robot, call: Any) -> None:
    with pytest.raises(ApexError):
        call(robot)


def frame(stamp: float = 1.5, **parts: Any) -> Frame:
    depth = np.full((48, 64), 1.2345)
    depth[0, 0] = 0.0
    color = np.zeros((48, 64, 3), np.uint8)
    color[2, 3] = 10, 20, 30
    return Frame(**{"camera": CAMERA, "depth": depth, "color": color, "stamp": stamp, "joints": {"a": 0.5}} | parts)


def test_a_frame_is_read_back_to_the_millimeter(tmp_path: Path) -> None:
    one = frame()
    one.save(tmp_path / "frame.npz")
    found = Frame.load(tmp_path / "frame.npz")
    assert found.camera == one.camera and found.stamp == 1.5 and dict(found.joints) == {"a": 0.5}
    np.testing.assert_allclose(found.depth, one.depth, atol=0.5e-3 + 1e-9)
    assert found.color is not None and (found.color == one.color).all()
    frame(color=None).save(tmp_path / "frame.npz")
    assert Frame.load(tmp_path / "frame.npz").color is None


def test_a_sequence_is_a_folder(tmp_path: Path) -> None:
    assert save_sequence([frame(0.1 * k) for k in range(12)], tmp_path / "frames") == 12
    np.testing.assert_allclose([one.stamp for one in load_frames(tmp_path / "frames")], 0.1 * np.arange(12))
    assert len(load_frames(tmp_path / "frames" / "000003.npz")) == 1
    with pytest.raises(ParameterError, match="after that of the frame before"):
        save_sequence([frame(1.0), frame(1.0)], tmp_path / "others")
    with pytest.raises(ParameterError, match="frames"):
        save_sequence([1], tmp_path / "others")  # type: ignore[list-item]
    (tmp_path / "none").mkdir()
    with pytest.raises(MissingFileError, match=r"\.npz"):
        load_frames(tmp_path / "none")
    (tmp_path / "frames" / "000004.npz").write_bytes((tmp_path / "frames" / "000001.npz").read_bytes())
    with pytest.raises(FileFormatError, match="000004"):
        load_frames(tmp_path / "frames")


@pytest.mark.parametrize(
    ("parts", "named"),
    [
        ({"depth": np.ones((3, 4))}, "depth"),
        ({"depth": np.full((48, 64), -1.0)}, "depth"),
        ({"depth": np.full((48, 64), 1234.5)}, "meters"),
        ({"color": np.zeros((48, 64, 3))}, "color"),
        ({"stamp": np.nan}, "stamp"),
        ({"joints": {"a": np.inf}}, "joints"),
        ({"joints": [1.0]}, "joints"),
        ({"camera": {}}, "camera"),
    ],
)
def test_faulty_frames_are_refused(parts: dict[str, Any], named: str) -> None:
    with pytest.raises(ParameterError, match=named):
        frame(**parts)


def test_joints_of_a_frame_are_a_state() -> None:
    one = frame(joints={"b": 2.0, "a": 1.0})
    np.testing.assert_array_equal(one.state(("a", "b")), [1.0, 2.0])
    with pytest.raises(ParameterError, match="'c'"):
        one.state(("a", "c"))


@pytest.mark.parametrize(
    "archive",
    [
        b"",
        {"depth": np.ones((48, 64))},
        {"frame": np.array('{"schema": "apex-ompl/frame/9"}')},
        {"frame": np.array('{"schema": "apex-ompl/frame/1", "camera": 3, "joints": {}, "stamp": 0}')},
        {"frame": np.array('{"schema": "apex-ompl/frame/1", "camera": {}, "joints": {}, "stamp": 0}')},
        {"frame": np.array('{"schema": "apex-ompl/frame/1", "extra": 3}')},
    ],
)
def test_faulty_frame_files_are_refused(tmp_path: Path, archive: Any) -> None:
    file = tmp_path / "frame.npz"
    if isinstance(archive, bytes):
        file.write_bytes(archive)
    else:
        np.savez(file, **archive)
    with pytest.raises(FileFormatError, match=r"frame\.npz"):
        Frame.load(file)


def test_units_of_depth_are_told_apart() -> None:
    intrinsics, pose = (40.0, 40.0, 1.5, 1.5), np.eye(4)
    expected = points_from_depth(np.full((4, 4), 1.2), intrinsics, pose)
    np.testing.assert_allclose(points_from_depth(np.full((4, 4), 1200, np.uint16), intrinsics, pose), expected)
    assert len(expected) == 16
    with pytest.raises(ParameterError, match="floats around 1200"):
        points_from_depth(np.full((4, 4), 1200.0), intrinsics, pose)
    sparse = np.zeros((200, 201))
    sparse[100, 150:] = 1200.0
    with pytest.raises(ParameterError, match="floats around 1200"):
        points_from_depth(sparse, intrinsics, pose)
    with pytest.raises(ParameterError, match="whole numbers up to 1"):
        points_from_depth(np.ones((4, 4), int), intrinsics, pose)
