"""Messages of ROS 2 as images and cameras, of any library whose messages have the fields of ``sensor_msgs``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import ParameterError
from apex_ompl.perception.camera import Camera
from apex_ompl.perception.library import opencv
from apex_ompl.util.schema import validate

COLORS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0]),
          "8UC3": (3, [2, 1, 0]), "mono8": (1, [0, 0, 0]), "8UC1": (1, [0, 0, 0])}  # fmt: skip
"""Encodings of colors: channels, and which of them are red, green and blue."""
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings of depths: whole millimeters of 16 bits, or meters."""
DEPTH_FORMATS = ("16UC1; compressedDepth", "16UC1; compressedDepth png")
DEPTH_HEADER = 12  # bytes before the PNG of a compressed depth image
PLUMB_BOB = 5  # coefficients
LARGEST_SKEW = 1e-6  # of the axes of pixels, by the focal length


def color_image(message: Any) -> NDArray[np.uint8]:
    """Return a ``sensor_msgs/Image`` or ``CompressedImage`` as red, green and blue, shape (height, width, 3).

    Raises:
        ParameterError: It has another encoding than those of 8 bits with one, three or four channels, fewer bytes than
            it says, or cannot be decoded.
        MissingFileError: It is compressed, and the extra ``perception`` is not installed.
    """
    if hasattr(message, "format"):
        return np.ascontiguousarray(_decoded(message, message.data, "color image", "IMREAD_COLOR")[..., ::-1])
    if message.encoding not in COLORS:
        raise ParameterError("color image", f"encoding {message.encoding!r}", ", ".join(COLORS))
    channels, order = COLORS[message.encoding]
    rows = _rows(message, np.dtype(np.uint8), channels, "color image")
    return np.ascontiguousarray(rows.reshape(message.height, message.width, channels)[..., order])


def depth_image(message: Any) -> NDArray[Any]:
    """Return a ``sensor_msgs/Image`` as depths, shape (height, width): uint16 [mm], or float32 [m] (REP 118).

    A ``CompressedImage`` of the transport ``compressedDepth`` is a PNG of 16 bits after a header.

    Raises:
        ParameterError: It has another encoding than 16UC1, mono16 or 32FC1, fewer bytes than it says, or is compressed
            in another way.
        MissingFileError: It is compressed, and the extra ``perception`` is not installed.
    """
    if hasattr(message, "format"):
        if message.format.strip() not in DEPTH_FORMATS:
            raise ParameterError("depth image", f"format {message.format!r}", " or ".join(DEPTH_FORMATS))
        found = _decoded(message, bytes(message.data)[DEPTH_HEADER:], "depth image", "IMREAD_UNCHANGED")
        if found.dtype != np.uint16 or found.ndim != 2:
            raise ParameterError("depth image", f"{found.dtype} of shape {found.shape}", "16 bits a pixel")
        return found
    if message.encoding not in DEPTHS:
        raise ParameterError("depth image", f"encoding {message.encoding!r}", ", ".join(DEPTHS))
    kind = np.dtype((">" if message.is_bigendian else "<") + DEPTHS[message.encoding])
    return _rows(message, kind, 1, "depth image").astype(kind.newbyteorder("="))


def _decoded(message: Any, data: Any, name: str, flag: str) -> NDArray[Any]:
    """Return an image that is compressed, as OpenCV has it: blue, green and red."""
    cv2 = opencv()
    given = np.frombuffer(data, np.uint8)
    found = cv2.imdecode(given, getattr(cv2, flag)) if len(given) else None
    if found is None:
        raise ParameterError(name, f"{len(given)} bytes of the format {message.format!r}", "a JPEG or PNG image")
    return np.asarray(found)


def _rows(message: Any, kind: np.dtype[Any], channels: int, name: str) -> NDArray[Any]:
    """Return the numbers of an image, whose rows may be padded, shape (height, width * channels)."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * kind.itemsize
    if not height or not width:
        raise ParameterError(name, f"{width} x {height} pixels", "an image with pixels")
    if step < row or len(message.data) < height * step:
        what = f"{height} rows of {row} bytes or more"
        raise ParameterError(name, f"{len(message.data)} bytes with a step of {step}", what)
    data = np.frombuffer(message.data, np.uint8, height * step).reshape(height, step)
    return np.ascontiguousarray(data[:, :row]).view(kind)


def camera_of(message: Any, name: str = "camera", *, link: str | None = None, rectified: bool = False) -> Camera:
    """Return the camera of a ``sensor_msgs/CameraInfo``, without a pose.

    Args:
        message: Its intrinsics.
        name: Name of the camera.
        link: Link that carries it.
        rectified: Whether its images are rectified (``image_rect``): then the intrinsics are those of P, without
            distortion.

    Raises:
        ApexError: The camera is not calibrated, has another distortion than ``plumb_bob``, or sends binned images or a
            part of them.
    """
    part = message.roi
    if max(message.binning_x, message.binning_y) > 1 or part.x_offset or part.y_offset:
        raise ParameterError("CameraInfo", "binned images, or a part of them", "whole images")
    matrix = np.asarray(message.p, float).reshape(3, 4) if rectified else np.asarray(message.k, float).reshape(3, 3)
    if not matrix[0, 0] > 0.0:
        raise ParameterError("CameraInfo", f"a focal length of {matrix[0, 0]:g}", "a camera that is calibrated")
    if abs(matrix[0, 1]) > LARGEST_SKEW * matrix[0, 0]:
        raise ParameterError("CameraInfo", f"a skew of {matrix[0, 1]:g}", "pixels whose axes are at a right angle")
    distortion = np.zeros(PLUMB_BOB)
    if not rectified:
        given = np.asarray(message.d, float)
        if given.any() and (message.distortion_model != "plumb_bob" or len(given) > PLUMB_BOB):
            model = f"{len(given)} numbers of the distortion {message.distortion_model!r}"
            raise ParameterError("CameraInfo", model, "plumb_bob with 5, or rectified images")
        distortion[: len(given[:PLUMB_BOB])] = given[:PLUMB_BOB]
    data = {
        "name": name, "link": link, "width": int(message.width), "height": int(message.height),
        "focal": (float(matrix[0, 0]), float(matrix[1, 1])), "center": (float(matrix[0, 2]), float(matrix[1, 2])),
        "distortion": tuple(distortion.tolist()),
    }  # fmt: skip
    return validate(Camera, data, "CameraInfo")
