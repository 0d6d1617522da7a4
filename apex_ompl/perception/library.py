"""The optional libraries: OpenCV and SciPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from apex_ompl.util.extras import import_extra


def opencv() -> Any:
    """Return the module ``cv2``.

    Raises:
        MissingFileError: The extra ``perception`` is not installed.
    """
    return import_extra("cv2", "images", "perception")


def least_squares() -> Callable[..., Any]:
    """Return ``scipy.optimize.least_squares``.

    Raises:
        MissingFileError: The extra ``perception`` is not installed.
    """
    found: Callable[..., Any] = import_extra("scipy.optimize", "least squares", "perception").least_squares
    return found


def assignment() -> Callable[..., Any]:
    """Return ``scipy.optimize.linear_sum_assignment``.

    Raises:
        MissingFileError: The extra ``perception`` is not installed.
    """
    found: Callable[..., Any] = import_extra("scipy.optimize", "assignment", "perception").linear_sum_assignment
    return found
