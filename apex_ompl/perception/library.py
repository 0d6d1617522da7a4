"""The optional libraries: OpenCV, SciPy and rosbags."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from apex_ompl.errors import MissingFileError
from apex_ompl.util.forking import unforked

HINT = "install the extra: apex-ompl[perception]"


def opencv() -> Any:
    """Return the module ``cv2``.

    Raises:
        MissingFileError: The extra ``perception`` is not installed.
    """
    try:
        with unforked():
            return import_module("cv2")
    except ImportError as error:
        raise MissingFileError("cv2", "package for images", HINT) from error


def least_squares() -> Callable[..., Any]:
    """Return ``scipy.optimize.least_squares``.

    Raises:
        MissingFileError: The extra ``perception`` is not installed.
    """
    try:
        with unforked():
            found: Callable[..., Any] = import_module("scipy.optimize").least_squares
            return found
    except ImportError as error:
        raise MissingFileError("scipy", "package for least squares", HINT) from error


def bag_reader() -> Callable[[Path], Any]:
    """Return a function that opens the folder of a bag of ROS 2.

    Raises:
        MissingFileError: The extra ``bags`` is not installed.
    """
    try:
        with unforked():
            reading, types = import_module("rosbags.highlevel"), import_module("rosbags.typesys")
    except ImportError as error:
        raise MissingFileError("rosbags", "package for bags of ROS 2", "install the extra: apex-ompl[bags]") from error
    store = types.get_typestore(types.Stores.ROS2_JAZZY)  # for bags without definitions
    return lambda path: reading.AnyReader([path], default_typestore=store)
