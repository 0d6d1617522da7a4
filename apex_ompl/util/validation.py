"""Checks of the numbers that callers give, in Python or on a command line."""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError


def is_number(value: object) -> bool:
    """Whether a value is a number; True and False are not."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def check_positive(value: float, name: str, expected: str) -> None:
    """Check a number.

    Raises:
        ParameterError: It is none, or not positive and finite.
    """
    if not is_number(value) or not 0.0 < value < np.inf:
        raise ParameterError(name, value, expected)


def numbers(given: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return finite numbers as an array.

    Raises:
        ParameterError: They are none.
    """
    try:
        found = np.array(given, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ParameterError(name, given, "finite numbers") from error
    if not np.isfinite(found).all():
        raise ParameterError(name, found[~np.isfinite(found)].flat[0], "finite numbers")
    return found


def whole_number(text: str) -> int:
    """Return a whole number, for ``argparse``.

    Raises:
        ArgumentTypeError: It is not one from 0 to 2147483647.
    """
    if not text.isdecimal() or not int(text) < 2**31:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number from 0 to 2147483647")
    return int(text)


def one_or_more(text: str) -> int:
    """Return a number of things, for ``argparse``.

    Raises:
        ArgumentTypeError: It is not a whole number from 1 to 2147483647.
    """
    if whole_number(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number, 1 or more")
    return int(text)
