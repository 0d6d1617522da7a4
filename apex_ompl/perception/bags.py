"""Frames from bags of ROS 2, read without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from apex_ompl.errors import ApexError, FileFormatError, MissingFileError, ParameterError, UnknownNameError
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.frames import Frame
from apex_ompl.perception.synchronizer import TOLERANCE, Synchronizer
from apex_ompl.util.extras import import_extra
from apex_ompl.util.files import path_text

ROLE = "bag of ROS 2"
COLOR, ALIGNED = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
INFO, STATES = "/camera/camera/color/camera_info", "/joint_states"
"""Topics of a RealSense camera with depths aligned to colors, and of joint states."""
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPES, STATES_TYPES = ("sensor_msgs/msg/CameraInfo",), ("sensor_msgs/msg/JointState",)


def bag_frames(
    path: str | PathLike[str], camera: Camera | None = None, *, color: str | None = COLOR,
    depth: str | None = ALIGNED, info: str | None = INFO, states: str | None = STATES,
    renamed: Mapping[str, str] | None = None, tolerance: float = TOLERANCE, rectified: bool = False,
) -> Iterator[Frame]:  # fmt: skip
    """Yield the frames of a bag (SQLite or MCAP), in order.

    The topics are by default those of a RealSense camera with depths aligned to colors.

    Args:
        path: Folder of the bag.
        camera: The camera; by default the intrinsics are those in the bag, and there is no pose.
        color: Topic of color images, or None.
        depth: Topic of depth images, or None.
        info: Topic of the intrinsics, which is not read with a camera.
        states: Topic of joint states, or None.
        renamed: Names of joints in ROS where they are others, by ours.
        tolerance: Largest time between what belongs together [s].
        rectified: Whether images are rectified.

    Raises:
        MissingFileError: There is no such folder, or the extra ``bags`` is not installed.
        UnknownNameError: The bag has no such topic.
        FileFormatError: It is no bag, a topic has messages of another type, a message is faulty, or no frame is
            complete.
        ParameterError: There are neither topics of images, nor intrinsics, or the tolerance is not positive.
    """
    file = Path(path_text(path))
    if camera is None and info is None:
        raise ParameterError("info", info, "the topic of the intrinsics, or a camera")
    together = Synchronizer(
        camera, color=color is not None, depth=depth is not None, states=states is not None, renamed=renamed,
        tolerance=tolerance, rectified=rectified,
    )  # fmt: skip
    kinds = [
        (color, IMAGE_TYPES, together.color), (depth, IMAGE_TYPES, together.depth),
        (states, STATES_TYPES, together.states), (info if camera is None else None, INFO_TYPES, together.info),
    ]  # fmt: skip
    takes = {topic: (kind, take) for topic, kind, take in kinds if topic is not None}
    if len(takes) < sum(topic is not None for topic, _, _ in kinds):
        raise ParameterError("topics", list(takes), "another topic for each kind of message")
    count = 0
    for topic, message in _messages(file, {topic: kind for topic, (kind, _) in takes.items()}):
        try:
            takes[topic][1](message)
            frames = together.ready()
        except ParameterError as error:
            raise FileFormatError(str(file), topic, error.value, f"expected {error.expected}") from error
        count += len(frames)
        yield from frames
    try:
        frames = together.ready(end=True)
    except ParameterError as error:
        raise FileFormatError(str(file), error.name, error.value, f"expected {error.expected}") from error
    yield from frames
    if not count + len(frames):
        why = "no intrinsics" if together.camera is None else "no images"
        why = ", ".join(f"{reason}: {n}" for reason, n in together.dropped.items()) or why
        raise FileFormatError(str(file), "", why, "expected a frame that is complete")


def _reader() -> Callable[[Path], Any]:
    """Return a function that opens the folder of a bag of ROS 2.

    Raises:
        MissingFileError: The extra ``bags`` is not installed.
    """
    reading, types = (import_extra(f"rosbags.{one}", "bags of ROS 2", "bags") for one in ("highlevel", "typesys"))
    store = types.get_typestore(types.Stores.ROS2_JAZZY)  # for bags without definitions
    return lambda path: reading.AnyReader([path], default_typestore=store)


def _messages(file: Path, types: Mapping[str, tuple[str, ...]]) -> Iterator[tuple[str, Any]]:
    """Yield topic and message of all messages of some topics, by topic and types, in the order in which they came."""
    if not file.is_dir():
        raise MissingFileError(str(file), ROLE, "expected a folder")
    try:
        with _reader()(file) as bag:
            there = {connection.topic: connection.msgtype for connection in bag.connections}
            for topic, known in types.items():
                if topic not in there:
                    raise UnknownNameError("topic", topic, tuple(there))
                if there[topic] not in known:
                    raise FileFormatError(str(file), topic, there[topic], f"expected messages of {' or '.join(known)}")
            wanted = [connection for connection in bag.connections if connection.topic in types]
            for connection, _, data in bag.messages(connections=wanted):
                yield connection.topic, bag.deserialize(data, connection.msgtype)
    except ApexError:
        raise
    except Exception as error:  # of several kinds, by what is broken
        why = " ".join(str(error).split()) or type(error).__name__
        raise FileFormatError(str(file), "", why, f"expected a {ROLE}") from error
