"""Errors that a caller can correct, each described in one sentence.

A planning failure is not an error but a status of the result. Every class descends from :class:`ApexError`, carries
its data as attributes, and prints one sentence that names the parameter or file, the value and what was expected.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


class ApexError(Exception):
    """Base class of all errors raised by this package; it can be sent between processes."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the message and the attributes for pickling, since the constructors take other arguments."""
        return _rebuilt, (type(self), self.args, self.__dict__)


def _rebuilt(kind: type[ApexError], args: tuple[Any, ...], attributes: dict[str, Any]) -> ApexError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(attributes)
    return error


def nearest_name(name: object, known: Iterable[str]) -> str | None:
    """Return the known name most like ``name``, or None when none is close or it is no text."""
    if not isinstance(name, str):
        return None
    matches = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return matches[0] if matches else None


class UnknownNameError(ApexError):
    """A name that is not registered.

    Attributes:
        kind: Kind of name, such as ``planner``.
        name: The unknown name.
        known: The known names.
    """

    def __init__(self, kind: str, name: object, known: Iterable[str]) -> None:
        """Compose the message ``unknown KIND NAME; known: ...``."""
        self.kind = kind
        self.name = name
        self.known = tuple(sorted(known))
        near = nearest_name(name, self.known)
        hint = f", did you mean {near!r}?" if near else ";"
        shown = self.known[:30]
        listing = ", ".join(shown) + (", ..." if len(shown) < len(self.known) else "") or "none"
        super().__init__(f"unknown {kind} {name!r}{hint} known: {listing}")


class FileFormatError(ApexError):
    """A file whose content does not follow its schema.

    Attributes:
        file: The file.
        field: Dotted path of the faulty field, or an empty string for the file itself.
        value: The faulty value.
        expected: Description of valid values.
    """

    def __init__(self, file: str, field: str, value: object, expected: str) -> None:
        """Compose the message ``file: field: expected ..., got ...``."""
        self.file = file
        self.field = field
        self.value = value
        self.expected = expected
        where = f"{file}: {field}" if field else file
        super().__init__(f"{where}: {expected}, got {_short(value)}")


class MissingFileError(ApexError):
    """A file that a problem, a robot or a caller names and that cannot be read.

    Attributes:
        file: The path.
        role: Description of the file.
    """

    def __init__(self, file: str, role: str, why: str = "no such file") -> None:
        """Compose the message ``ROLE FILE: why``."""
        self.file = file
        self.role = role
        super().__init__(f"{role} {file!r}: {why}")


class ParameterError(ApexError):
    """An argument outside its range or of the wrong kind.

    Attributes:
        name: The parameter.
        value: The faulty value.
        expected: Description of valid values.
    """

    def __init__(self, name: str, value: object, expected: str) -> None:
        """Compose the message ``name: expected ..., got ...``."""
        self.name = name
        self.value = value
        self.expected = expected
        super().__init__(f"{name}: expected {expected}, got {_short(value)}")


class FolderInUseError(ApexError):
    """A folder that another process writes into.

    Attributes:
        folder: The folder.
    """

    def __init__(self, folder: str) -> None:
        """Compose the message."""
        self.folder = folder
        super().__init__(f"{folder}: another process writes here, expected one at a time")


class TimingError(ApexError):
    """A path without a time parameterization."""


class TimingStoppedError(TimingError):
    """A time parameterization that was told to stop before it had a valid motion."""


class PlannerProcessError(ApexError):
    """The process in which replans are made could not be made ready."""


class DriverError(ApexError):
    """A robot, or a controller of it, does not answer, or is not where it may be."""


class RobotError(ApexError):
    """A robot description that is not valid."""


class ConstraintError(ApexError):
    """A constraint along a path that no state satisfies, or that no joint can change.

    Attributes:
        constraint: Name of the constraint, or names with commas between them.
    """

    def __init__(self, constraint: str, reason: str) -> None:
        """Compose the message ``CONSTRAINT: reason``."""
        self.constraint = constraint
        super().__init__(f"{constraint}: {reason}")


class SceneError(ApexError):
    """A scene change that is not possible, such as removing an obstacle that does not exist."""


def _short(value: object, limit: int = 80) -> str:
    """Return ``repr(value)`` cut to ``limit`` characters, on one line."""
    try:
        text = repr(value)
    except Exception:  # of an integer of more than 4300 digits, or of a class whose text fails
        text = object.__repr__(value)
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."
