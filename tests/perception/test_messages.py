"""Images, intrinsics and bags of ROS 2, by the messages of rosbags and, where it is installed, of ``sensor_msgs``."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from images import CAMERA, START, Ros, Rosbags, compressed, image, info, states, store

from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.perception import Camera, Frame, Synchronizer, bag_frames, load_frames, look_at, save_sequence
from apex_ompl.perception.bags import ALIGNED, COLOR, INFO, STATES
from apex_ompl.perception.messages import camera_of, color_image, depth_image

pytest.importorskip("rosbags")

from rosbags.rosbag2 import StoragePlugin, Writer  # noqa: E402 - after the check


def sources() -> list[Any]:
    missing = pytest.mark.skipif(find_spec("sensor_msgs") is None, reason="no ROS 2")
    return [pytest.param(Rosbags(), id="rosbags"), pytest.param(Ros(), id="ros", marks=missing)]


def empty(source: Rosbags) -> Any:
    """Return a message of an image without rows."""
    found = image(source, np.zeros((1, 6), np.uint16), "16UC1")
    found.height = 0
    return found


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("source", sources())
def test_colors_of_any_layout_are_read(source: Rosbags, padding: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (4, 6, 3), np.uint8)
    alpha = np.concatenate([pixels, np.full((4, 6, 1), 9, np.uint8)], axis=2)
    reversed_alpha = np.concatenate([pixels[..., ::-1], alpha[..., 3:]], axis=2)
    for encoding, given in (
        ("rgb8", pixels), ("bgr8", pixels[..., ::-1]), ("rgba8", alpha), ("bgra8", reversed_alpha),
    ):  # fmt: skip
        np.testing.assert_array_equal(color_image(image(source, given, encoding, padding=padding)), pixels)
    gray = color_image(image(source, pixels[..., 0], "mono8", padding=padding))
    np.testing.assert_array_equal(gray, np.repeat(pixels[..., :1], 3, axis=2))


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("source", sources())
def test_depths_keep_their_unit(source: Rosbags, big: bool) -> None:
    meters = np.random.default_rng(0).uniform(0.5, 2.0, (4, 6)).astype(np.float32)
    meters[0, :3] = np.nan, np.inf, -np.inf  # no depth, too far, too near (REP 118)
    floats = depth_image(image(source, meters, "32FC1", padding=4, big=big))
    np.testing.assert_array_equal(floats, meters)
    millimeters = np.round(1e3 * np.where(np.isfinite(meters), meters, 0.0)).astype(np.uint16)
    whole = depth_image(image(source, millimeters, "16UC1", padding=2, big=big))
    np.testing.assert_array_equal(whole, millimeters)
    frames = [Frame(CAMERA, depth) for depth in (floats, whole)]
    np.testing.assert_allclose(frames[0].depth, frames[1].depth, atol=0.51e-3)
    assert not frames[0].depth[0, :3].any()


@pytest.mark.parametrize("source", sources())
def test_compressed_images_are_decoded(source: Rosbags) -> None:
    pytest.importorskip("cv2")
    rows, columns = np.mgrid[0:48, 0:64]
    color = np.stack([4 * columns, 5 * rows, 2 * (rows + columns)], axis=-1).astype(np.uint8)
    exact = color_image(compressed(source, color, "rgb8; png compressed bgr8", ".png"))
    np.testing.assert_array_equal(exact, color)
    lossy = color_image(compressed(source, color, "rgb8; jpeg compressed bgr8", ".jpg")).astype(int)
    assert lossy.shape == color.shape and np.abs(lossy - color).mean() < 4.0
    depth = (1000 + rows * columns).astype(np.uint16)
    for form in ("16UC1; compressedDepth png", "16UC1; compressedDepth"):
        found = depth_image(compressed(source, depth, form, ".png", head=bytes(12)))
        np.testing.assert_array_equal(found, depth)
    for message, named in (
        (compressed(source, depth, "32FC1; compressedDepth png", ".png", head=bytes(12)), "32FC1"),
        (compressed(source, depth, "16UC1; compressedDepth rvl", ".png", head=bytes(12)), "rvl"),
        (compressed(source, depth, "16UC1; compressedDepth", ".png"), "JPEG or PNG"),
        (compressed(source, color, "16UC1; compressedDepth", ".png", head=bytes(12)), "16 bits a pixel"),
    ):
        with pytest.raises(ParameterError, match=named):
            depth_image(message)
    with pytest.raises(ParameterError, match="JPEG or PNG"):
        color_image(source.stamped("sensor_msgs/CompressedImage", START, format="jpeg", data=np.zeros(9, np.uint8)))


@pytest.mark.parametrize("source", sources())
def test_intrinsics_are_those_of_the_message(source: Rosbags) -> None:
    assert camera_of(info(source)) == CAMERA
    rectified = camera_of(info(source), "left", link="hand", rectified=True)
    expected = CAMERA.model_copy(
        update={"name": "left", "link": "hand", "focal": (4.8, 4.9), "center": (2.4, 1.4), "distortion": (0.0,) * 5}
    )
    assert rectified == expected
    straight = CAMERA.model_copy(update={"distortion": (0.0,) * 5})
    assert camera_of(info(source, straight, distortion_model="", d=np.zeros(0))) == straight


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda s: color_image(image(s, np.zeros((4, 6, 2), np.uint8), "yuv422_yuy2")), "yuv422"),
        (lambda s: color_image(image(s, np.zeros((4, 6), np.uint16), "16UC1")), "rgb8, bgr8"),
        (lambda s: depth_image(image(s, np.zeros((4, 6, 3), np.uint8), "rgb8")), "16UC1, mono16, 32FC1"),
        (lambda s: depth_image(image(s, np.zeros((4, 6), np.uint8), "16UC1")), "24 bytes with a step of 6"),
        (lambda s: depth_image(empty(s)), "6 x 0 pixels"),
        (lambda s: camera_of(info(s, k=np.zeros(9))), "calibrated"),
        (lambda s: camera_of(info(s, distortion_model="equidistant")), "equidistant"),
        (lambda s: camera_of(info(s, d=np.arange(8.0), distortion_model="rational_polynomial")), "8 numbers"),
        (lambda s: camera_of(info(s, binning_x=2)), "whole images"),
        (lambda s: camera_of(info(s, roi=s.region(x_offset=3))), "whole images"),
        (lambda s: camera_of(info(s, k=np.array([5.0, 0.3, 2.0, 0.0, 5.0, 2.0, 0.0, 0.0, 1.0]))), "skew"),
        (lambda s: camera_of(info(s, k=np.array([5.0, 0.0, 99.0, 0.0, 5.0, 2.0, 0.0, 0.0, 1.0]))), "principal point"),
        (lambda s: Synchronizer(color=False, depth=False), "colors, depths, or both"),
        (lambda s: Synchronizer(tolerance=-1.0), "tolerance"),
        (lambda s: Synchronizer(CAMERA.pose), "a Camera"),
        (lambda s: Synchronizer(renamed={"a": "x", "b": "x"}), "renamed"),
    ],
)
@pytest.mark.parametrize("source", sources())
def test_faulty_messages_are_refused(source: Rosbags, call: Any, named: str) -> None:
    with pytest.raises(ApexError, match=named):
        call(source)


def shot(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return color and depth [mm] of a frame by its number."""
    return np.full((4, 6, 3), k, np.uint8), np.full((4, 6), 1000 + k, np.uint16)


@pytest.mark.parametrize("source", sources())
def test_what_belongs_together_becomes_a_frame(source: Rosbags) -> None:
    """Two broadcasters of joint states that move at known velocities, and colors half a period late or missing."""
    together, found, second = Synchronizer(renamed={"ours": "theirs"}, tolerance=0.04), [], 10**9
    together.info(info(source))
    for k in range(8):
        at = START + k * second // 10
        color, depth = shot(k)
        together.depth(image(source, depth, "16UC1", at))
        if k != 3:
            together.color(image(source, color, "rgb8", at + second // 200))
        for early in (-0.03, 0.03):
            time = 0.1 * k + early
            ns = START + round(time * second)
            if k != 5:
                together.states(states(source, ns, theirs=2.0 * time, other=-time))
            together.states(states(source, ns + second // 100, third=3.0 * (time + 0.01)))
        found += together.ready()
    found += together.ready(end=True)
    assert [one.stamp - found[0].stamp for one in found] == pytest.approx([0.0, 0.1, 0.2, 0.4, 0.6, 0.7], abs=1e-6)
    for one in found:
        time = one.stamp - found[0].stamp
        k = round(10 * time)
        assert one.color is not None and (one.color == k).all() and one.depth[0, 0] == pytest.approx(1.0 + 1e-3 * k)
        expected = {"ours": 2.0 * time, "other": -time, "third": 3.0 * time}
        assert dict(one.joints) == pytest.approx(expected, abs=1e-6)
        assert one.camera == CAMERA
    assert together.dropped == {"no color image of that time": 1, "no joint states of that time": 1}


def test_images_without_states_or_depths(tmp_path: Path) -> None:
    source, alone = Rosbags(), Synchronizer(CAMERA, depth=False, states=False)
    for k in (0, 1, 1):
        alone.color(image(source, shot(k)[0], "rgb8", START + k))
    first, second = alone.ready()
    assert not first.depth.any() and not first.joints and second.color is not None and (second.color == 1).all()
    assert alone.dropped == {"not later than the image before": 1}
    with pytest.raises(ParameterError, match="depth"):
        wrong = Synchronizer(CAMERA, color=False, states=False)
        wrong.depth(image(source, np.ones((3, 3), np.uint16) * 900, "16UC1"))
        wrong.ready()


def write_bag(folder: Path, *, plugin: StoragePlugin, count: int = 5, packed: bool = False, **parts: bool) -> None:
    """Write a bag of a camera at 10 Hz, whose images may be compressed, and joint states at 50 Hz."""
    of_images = "CompressedImage" if packed else "Image"
    source, kinds = Rosbags(), {COLOR: of_images, ALIGNED: of_images, INFO: "CameraInfo", STATES: "JointState"}
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        links = {
            topic: writer.add_connection(topic, f"sensor_msgs/msg/{kind}", typestore=store())
            for topic, kind in kinds.items()
        }

        def write(topic: str, message: Any, ns: int) -> None:
            kind = f"sensor_msgs/msg/{kinds[topic]}"
            writer.write(links[topic], ns, store().serialize_cdr(message, kind))

        for tick in range(5 * count):
            ns = START + tick * 20_000_000
            write(STATES, states(source, ns, joint=0.02 * tick), ns)
            if tick % 5 == 1:
                color, depth = shot(tick // 5)
                at = ns + 5_000_000
                if parts.get("info", True):
                    write(INFO, info(source), at)
                if packed:
                    depths = compressed(source, depth, "16UC1; compressedDepth png", ".png", ns=at, head=bytes(12))
                    colors = compressed(source, color, "rgb8; png compressed bgr8", ".png", ns=at)
                else:
                    depths, colors = image(source, depth, "16UC1", at), image(source, color, "rgb8", at)
                write(ALIGNED, depths, at)
                write(COLOR, colors, at)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=["mcap", "sqlite"])
def test_a_bag_is_read_without_ros(tmp_path: Path, plugin: StoragePlugin, packed: bool) -> None:
    if packed:
        pytest.importorskip("cv2")
    write_bag(tmp_path / "bag", plugin=plugin, packed=packed)
    assert save_sequence(bag_frames(tmp_path / "bag"), tmp_path / "frames") == 5
    found = load_frames(tmp_path / "frames")
    for k, one in enumerate(found):
        assert one.stamp == pytest.approx(START / 1e9 + 0.1 * k + 0.025, abs=1e-6)
        assert dict(one.joints) == pytest.approx({"joint": 0.1 * k + 0.025}, abs=1e-6)
        assert one.color is not None and (one.color == k).all() and (one.depth == (1000 + k) * 1e-3).all()
        assert one.camera == CAMERA
    placed = CAMERA.placed(look_at((1.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
    assert next(bag_frames(tmp_path / "bag", placed, info=None)).camera == placed


@pytest.mark.parametrize(
    ("options", "error", "named"),
    [
        ({"color": "/none"}, UnknownNameError, "/joint_states"),
        ({"color": STATES, "states": None}, FileFormatError, "expected messages of sensor_msgs/msg/Image"),
        ({"color": STATES}, ParameterError, "another topic for each kind"),
        ({"depth": COLOR, "color": None}, FileFormatError, "rgb8"),
        ({"color": None, "depth": None}, ParameterError, "colors, depths, or both"),
        ({"info": None}, ParameterError, "intrinsics"),
        ({"camera": Camera(width=5, height=4, focal=(5, 5), center=(2, 2))}, FileFormatError, r"\(4, 5\)"),
    ],
)
def test_faulty_options_of_bags_are_named(tmp_path: Path, options: Any, error: Any, named: str) -> None:
    write_bag(tmp_path / "bag", plugin=StoragePlugin.MCAP, count=2)
    with pytest.raises(error, match=named):
        list(bag_frames(tmp_path / "bag", **options))


def test_faulty_bags_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingFileError, match="bag of ROS 2"):
        list(bag_frames(tmp_path / "none"))
    with pytest.raises(FileFormatError, match="expected a bag of ROS 2"):
        list(bag_frames(tmp_path))
    write_bag(tmp_path / "bare", plugin=StoragePlugin.MCAP, count=2, info=False)
    with pytest.raises(FileFormatError, match="no intrinsics"):
        list(bag_frames(tmp_path / "bare"))
    write_bag(tmp_path / "cut", plugin=StoragePlugin.MCAP, count=2)
    data = next((tmp_path / "cut").glob("*.mcap"))
    data.write_bytes(data.read_bytes()[:300])
    with pytest.raises(FileFormatError, match="expected a bag of ROS 2"):
        list(bag_frames(tmp_path / "cut"))
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(MissingFileError, match=r"apex-ompl\[bags\]"):
        list(bag_frames(tmp_path / "bare"))


def test_states_of_other_messages_are_left_out() -> None:
    """Positions that are not finite, and lists of other lengths, as from a broadcaster that starts."""
    together = Synchronizer(CAMERA, color=False)
    stamp = SimpleNamespace(sec=1, nanosec=0)
    header = SimpleNamespace(stamp=stamp)
    together.states(SimpleNamespace(header=header, name=["a", "b", "c"], position=[np.nan, 2.0]))
    together.depth(image(Rosbags(), shot(0)[1], "16UC1", 10**9))
    (frame,) = together.ready(end=True)
    assert dict(frame.joints) == {"b": 2.0}
