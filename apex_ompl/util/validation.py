"""Checks of numbers and arrays that callers give, in Python or on a command line.

All number and shape checks of the package are made here, so that their messages are worded alike.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from apex_ompl.errors import ParameterError, UnknownNameError
from apex_ompl.types import Array
from apex_ompl.util.arrays import is_masked_array

LARGEST_INT = 2**31 - 1
"""Largest seed or count, the largest signed integer of 32 bits."""


def is_number(value: object) -> bool:
    """Whether a value is a number; True and False are not."""
    return isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)


def is_integer(value: object) -> bool:
    """Whether a value is an integer of Python or NumPy; True and False are not."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def check_name(name: str, kind: str, known: Collection[str]) -> str:
    """Return a name after checking that it is one of those that are known.

    Args:
        name: The name.
        kind: What it is the name of, such as ``planner``.
        known: The names that there are.

    Raises:
        UnknownNameError: There is no such name, or it is no text.
    """
    if not isinstance(name, str) or name not in known:
        raise UnknownNameError(kind, name, known)
    return name


def check_options(given: Mapping[str, Any], known: Collection[str]) -> None:
    """Check the names of options that a call takes as keywords and hands on.

    Raises:
        UnknownNameError: There is no option of a name.
    """
    for name in given:
        check_name(name, "option", known)


def check_flag(value: bool, name: str) -> bool:
    """Return a truth value as a ``bool`` after checking that it is one.

    Raises:
        ParameterError: It is none, such as a text.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ParameterError(name, value, "True or False")
    return bool(value)


def check_number(value: float, name: str, low: float = -np.inf, high: float = np.inf) -> None:
    """Check that a finite number lies in the closed interval [low, high].

    Raises:
        ParameterError: It does not, or the value is no finite number.
    """
    if not _is_finite(value) or not low <= value <= high:
        raise ParameterError(name, value, _in_range("a number", low, high))


def check_positive(value: float, name: str, expected: str = "a positive number") -> None:
    """Check that a number is positive and finite.

    Args:
        value: The number.
        name: Its name in the error.
        expected: What the error asks for, such as ``a positive number of seconds``.

    Raises:
        ParameterError: The value is no number, not positive, or not finite.
    """
    if not _is_finite(value) or not value > 0.0:
        raise ParameterError(name, value, expected)


def check_integer(value: int, name: str, low: int = 0, high: int | None = None) -> int:
    """Return an integer as an ``int`` after checking that it lies in [low, high].

    Raises:
        ParameterError: It does not, or the value is no integer.
    """
    if not is_integer(value) or value < low or (high is not None and value > high):
        raise ParameterError(name, value, _in_range("a whole number", low, high))
    return int(value)


def check_seed(seed: int) -> int:
    """Return a seed as an ``int`` after checking that it lies in [0, 2147483647].

    Raises:
        ParameterError: It does not, or the value is no integer.
    """
    return check_integer(seed, "seed", 0, LARGEST_INT)


def _is_finite(value: object) -> bool:
    """Whether a value is a finite number, and no integer too large for a float."""
    try:
        return is_number(value) and bool(np.isfinite(float(value)))  # type: ignore[arg-type]
    except OverflowError:
        return False


def _in_range(what: str, low: float, high: float | None) -> str:
    """Return the words for a range, such as ``a number, 0 or more`` or ``a number from 0 to 1``."""
    if high is not None and high < np.inf:
        return f"{what} from {_shown(low)} to {_shown(high)}"
    return what if low == -np.inf else f"{what}, {_shown(low)} or more"


def _shown(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"


def number_array(given: Any, name: str, expected: str = "numbers") -> Array:
    """Return real numbers as an array of floats, the same array where it is one; NaN and infinity are numbers.

    NumPy alone takes the numbers below a mask, which are not known, the real part of complex numbers, texts, and True.

    Args:
        given: Numbers, in an array or in nested sequences of one shape.
        name: Their name in the error.
        expected: What the error asks for.

    Raises:
        ParameterError: One is no number, is masked, or the sequences are ragged.
    """
    if type(given) is np.ndarray and given.dtype == float:
        return given
    if _is_masked(given):
        raise ParameterError(name, given, f"{expected}, none of them masked")
    try:
        found = np.asarray(given)
        if found.dtype.kind not in "iufO" or (found.dtype.kind == "O" and not all(map(_is_real, found.flat))):
            raise ParameterError(name, given, expected)
        return np.asarray(found, float)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # the last from tensors that have a gradient
        why = " without a gradient" if getattr(given, "requires_grad", False) else ""
        raise ParameterError(name, given, f"{expected}{why}") from error


def _is_masked(given: object) -> bool:
    """Whether a number of an array, or of a sequence of some, is masked."""
    if isinstance(given, (list, tuple)):
        return any(map(_is_masked, given)) if any(not isinstance(one, (int, float)) for one in given) else False
    return is_masked_array(given) and bool(np.ma.getmaskarray(given).any())


def _is_real(value: object) -> bool:
    return value is not None and not isinstance(value, (str, bytes, bool, np.bool_, complex, np.complexfloating))


def finite_array(given: ArrayLike, name: str) -> Array:
    """Return a copy of finite numbers as an array, in C's order.

    Raises:
        ParameterError: One is no finite number.
    """
    found = np.array(number_array(given, name, "finite numbers"), order="C")
    if not np.isfinite(found).all():
        raise ParameterError(name, float(found[~np.isfinite(found)].flat[0]), "finite numbers")
    return found


def finite_numbers(given: Mapping[str, Any], name: str) -> dict[str, float]:
    """Return finite numbers by name.

    Raises:
        ParameterError: One is no finite number.
    """
    return {str(key): float(finite_array(value, f"{name}.{key}")) for key, value in given.items()}


def check_nonnegative(values: ArrayLike, name: str) -> None:
    """Check that each of some numbers is 0 or more; infinity is allowed.

    Raises:
        ParameterError: One is negative or NaN.
    """
    if not (np.asarray(values) >= 0.0).all():
        raise ParameterError(name, values, "a number, 0 or more")


def check_indices(chosen: Iterable[int] | NDArray[np.intp], count: int, name: str, what: str) -> None:
    """Check that integers number some of ``count`` items, such as ``planned joints``.

    Raises:
        ParameterError: One is not in [0, count - 1].
    """
    if any(k not in range(count) for k in chosen):
        raise ParameterError(name, list(chosen), f"numbers of {what}, 0 to {count - 1}")


def check_array(array: Array, shape: Sequence[int | str], name: str, *, finite: bool = False, least: int = 0) -> None:
    """Check the shape of an array and, with ``finite``, that all its numbers are finite.

    Args:
        array: The array.
        shape: The size of each axis: a number, or a letter such as ``N`` where any size is good.
        name: Its name in the error.
        finite: Whether NaN and infinity are refused.
        least: Smallest size of the first axis.

    Raises:
        ParameterError: The array has another shape, or a number that is not finite.
    """
    fits = array.ndim == len(shape) and all(
        isinstance(wanted, str) or size == wanted for size, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits or len(array) < least:
        raise shape_error(array, shape, name, finite=finite, least=least)
    if finite and not np.isfinite(array).all():
        error = shape_error(array, shape, name, finite=True, least=least)
        raise ParameterError(name, float(array[~np.isfinite(array)].flat[0]), error.expected)


RIGID = 1e-3
"""How far the entries of R^T R may be from those of the identity for a rotation matrix R."""


def rigid_pose(given: ArrayLike, name: str) -> Array:
    """Return a pose as an array after checking that it is a rotation and a translation, shape (4, 4) [m].

    Raises:
        ParameterError: Another shape, a number that is not finite, a scale, a shear, or a reflection.
    """
    pose = finite_array(given, name)
    check_array(pose, (4, 4), name)
    turn = pose[:3, :3]
    if not np.allclose(pose[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=RIGID):
        raise ParameterError(name, pose[3].tolist(), "a rigid pose, whose last row is 0 0 0 1")
    if not np.allclose(turn.T @ turn, np.eye(3), rtol=0.0, atol=RIGID) or np.linalg.det(turn) < 0.0:
        raise ParameterError(name, turn.tolist(), "a rigid pose, whose 3 x 3 part is a rotation matrix")
    return pose


def shape_error(
    array: Array, shape: Sequence[int | str], name: str, *, finite: bool = False, least: int = 0
) -> ParameterError:
    """Return the error of :func:`check_array`, for functions called so often that they compare shapes themselves."""
    sizes = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    what = "finite numbers" if finite else "an array"
    rows = f", {shape[0]} at least {least}" if least > 0 else ""
    return ParameterError(name, array.shape, f"{what} of shape ({sizes}){rows}")


def check_states(states: Array, dof: int, name: str = "states", *, least: int = 0) -> None:
    """Check that an array holds states, one a row: shape (N, dof) with N at least ``least``.

    Raises:
        ParameterError: Another shape, or fewer rows.
    """
    check_array(states, ("N", dof), name, least=least)


def check_path(path: ArrayLike, name: str = "path") -> Array:
    """Return a path as an array, shape (N, dof), after checking that it has two finite states or more.

    Raises:
        ParameterError: Another shape, fewer states, or a number that is not finite.
    """
    states = number_array(path, name)
    check_array(states, ("N", "dof"), name, finite=True, least=2)
    return states


def check_times(times: Array, count: int | None = None) -> None:
    """Check that times, shape (N,) or (count,), are finite, start with 0 and increase strictly.

    Raises:
        ParameterError: They do not.
    """
    check_array(times, ("N" if count is None else count,), "times", finite=True, least=1)
    if times[0] != 0.0 or not (np.diff(times) > 0.0).all():
        raise ParameterError("times", times, "times that start at 0 and increase")


def degrees_hint(angles: float | Sequence[float], is_inside: Callable[..., bool]) -> str:
    """Return the end of a sentence on angles that would be valid in degrees, or an empty string.

    Args:
        angles: An angle or several, that are not valid.
        is_inside: Whether angles in radians are valid, one argument each.
    """
    given = np.atleast_1d(np.asarray(angles, float))
    degrees = np.abs(given).max() > 2.0 * np.pi and is_inside(*np.radians(given).tolist())
    return "; in degrees it would be inside, and angles are radians" if degrees else ""


def whole_number(text: str) -> int:
    """Return the integer that a text gives; a type of ``argparse``.

    Raises:
        ArgumentTypeError: It is not a whole number from 0 to 2147483647.
    """
    if not text.isdecimal() or not int(text) <= LARGEST_INT:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number from 0 to {LARGEST_INT}")
    return int(text)


def one_or_more(text: str) -> int:
    """Return the positive integer that a text gives; a type of ``argparse``.

    Raises:
        ArgumentTypeError: It is not a whole number from 1 to 2147483647.
    """
    if whole_number(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number, 1 or more")
    return int(text)


def positive_number(text: str) -> float:
    """Return the positive finite number that a text gives; a type of ``argparse``.

    Raises:
        ArgumentTypeError: It is not one.
    """
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r}, expected a positive number")
    return value


def key_value(text: str) -> tuple[str, Any]:
    """Return the key and the value, read as YAML, of a text KEY=VALUE; a type of ``argparse``.

    Raises:
        ArgumentTypeError: It is not one.
    """
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise argparse.ArgumentTypeError(f"{text!r}, expected KEY=VALUE")
    import yaml

    try:
        from apex_ompl.util.schema import yaml_value  # data are made on machines without pydantic

        return key, yaml_value(value)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a value in YAML") from error
