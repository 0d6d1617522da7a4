"""The optional library MuJoCo."""

from __future__ import annotations

import os
from ctypes.util import find_library
from importlib import import_module
from typing import Any

from apex_ompl.errors import MissingFileError
from apex_ompl.util.forking import unforked


def mujoco() -> Any:
    """Return the module ``mujoco``, set up to draw by EGL or OSMesa on a machine without a display.

    Raises:
        MissingFileError: The extra ``twin`` is not installed.
    """
    if not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "osmesa")  # which is read at the import
    try:
        with unforked():
            return import_module("mujoco")
    except ImportError as error:
        raise MissingFileError("mujoco", "package for physics", "install the extra: apex-ompl[twin]") from error
