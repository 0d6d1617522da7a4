"""The optional libraries: OpenCV and SciPy."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
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
