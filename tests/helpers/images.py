"""Messages of images, intrinsics and joint states, of rosbags and of a ROS 2."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

import numpy as np

from apex_ompl.perception import Camera

START = 1_700_000_000_000_000_000  # [ns]
CAMERA = Camera(width=6, height=4, focal=(5.0, 5.1), center=(2.5, 1.5), distortion=(0.01, -0.02, 0.001, 0.002, 0.003))


@cache
def store() -> Any:
    """Return the types of ROS 2."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


class Rosbags:
    """Messages of rosbags."""

    def message(self, kind: str, **fields: Any) -> Any:
        return store().types[kind.replace("/", "/msg/")](**fields)

    def stamped(self, kind: str, ns: int, **fields: Any) -> Any:
        stamp = self.message("builtin_interfaces/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return self.message(kind, header=self.message("std_msgs/Header", stamp=stamp, frame_id="camera"), **fields)

    def region(self, **fields: Any) -> Any:
        zero = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        return self.message("sensor_msgs/RegionOfInterest", **zero | fields)


class Ros(Rosbags):
    """Messages of a ROS 2."""

    def message(self, kind: str, **fields: Any) -> Any:
        module, name = kind.split("/")
        found = getattr(import_module(f"{module}.msg"), name)()
        for field, value in fields.items():
            listed = isinstance(value, np.ndarray) and field != "data"
            if field == "data":
                found.data.frombytes(np.asarray(value).tobytes())
            else:
                setattr(found, field, value.tolist() if listed else value)
        return found


def image(
    source: Rosbags, pixels: np.ndarray, encoding: str, ns: int = START, *, padding: int = 0, big: bool = False
) -> Any:
    """Return a message of an image, shape (height, width) or with channels, whose rows are padded by some bytes."""
    height, width = pixels.shape[:2]
    ordered = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = np.ascontiguousarray(ordered).reshape(height, -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return source.stamped(
        "sensor_msgs/Image", ns, height=height, width=width, encoding=encoding, is_bigendian=int(big),
        step=rows.shape[1], data=rows.ravel(),
    )  # fmt: skip


def compressed(
    source: Rosbags, pixels: np.ndarray, form: str, suffix: str, *, ns: int = START, head: bytes = b""
) -> Any:
    """Return a message of a compressed image: of colors red, green and blue, or of depths."""
    import cv2

    ordered = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    data = np.frombuffer(head + cv2.imencode(suffix, ordered)[1].tobytes(), np.uint8)
    return source.stamped("sensor_msgs/CompressedImage", ns, format=form, data=data)


def info(source: Rosbags, camera: Camera = CAMERA, **changes: Any) -> Any:
    fx, fy, cx, cy = *camera.focal, *camera.center
    fields = {
        "height": camera.height, "width": camera.width, "distortion_model": "plumb_bob",
        "d": np.array(camera.distortion), "k": np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        "r": np.eye(3).ravel(), "p": np.array([4.8, 0.0, 2.4, 0.0, 0.0, 4.9, 1.4, 0.0, 0.0, 0.0, 1.0, 0.0]),
        "binning_x": 0, "binning_y": 0, "roi": source.region(),
    }  # fmt: skip
    return source.stamped("sensor_msgs/CameraInfo", START, **fields | changes)


def states(source: Rosbags, ns: int, **joints: float) -> Any:
    positions = np.array(list(joints.values()))
    return source.stamped(
        "sensor_msgs/JointState", ns, name=list(joints), position=positions, velocity=np.zeros(0), effort=np.zeros(0)
    )
