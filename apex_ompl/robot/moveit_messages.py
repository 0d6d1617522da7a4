"""Messages of ROS in YAML files: access to their parts, with errors that name the place in the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.errors import FileFormatError
from apex_ompl.types import Array
from apex_ompl.util.validation import is_number


@dataclass
class MessageReader:
    """Reads parts of the messages in a file; all methods raise a FileFormatError where a part has another form."""

    file: Path

    def fail(self, where: str, value: object, expected: str) -> FileFormatError:
        """Return the error of a value in the file."""
        return FileFormatError(str(self.file), where, value, expected)

    def section(self, data: Mapping[str, Any], key: str, where: str = "") -> Mapping[str, Any]:
        """Return a mapping inside a message, empty where it is not given."""
        found = data.get(key)
        if found is not None and not isinstance(found, Mapping):
            raise self.fail(inside(where, key), found, "expected a mapping of keys to values")
        return found or {}

    def entries(self, data: Mapping[str, Any], key: str, where: str = "") -> list[Any]:
        """Return a list inside a message, empty where it is not given."""
        found = data.get(key)
        if found is not None and not isinstance(found, list):
            raise self.fail(inside(where, key), found, "expected a list")
        return found or []

    def messages(self, data: Mapping[str, Any], key: str, where: str = "") -> list[Mapping[str, Any]]:
        """Return a list of messages inside a message, empty where it is not given."""
        found = self.entries(data, key, where)
        for k, item in enumerate(found):
            if not isinstance(item, Mapping):
                raise self.fail(f"{inside(where, key)}.{k}", item, "expected a mapping of keys to values")
        return found

    def number(self, value: Any, where: str) -> float:
        """Return a finite number."""
        if not is_number(value) or not np.isfinite(value):
            raise self.fail(where, value, "expected a finite number")
        return float(value)

    def flag(self, value: Any, where: str) -> bool:
        """Return a truth value, which a text such as ``"false"`` is not."""
        if not isinstance(value, bool):
            raise self.fail(where, value, "expected true or false")
        return value

    def numbers(self, data: Any, keys: str, default: Sequence[float], where: str) -> Array:
        """Return an array of finite numbers, given as a list or by their keys.

        Args:
            data: The message.
            keys: Their keys, one letter each.
            default: Values of those that are not given.
            where: Place of the message in the file.

        Raises:
            FileFormatError: It holds something else.
        """
        if data is None:
            return np.array(default)
        values = [data.get(k, d) for k, d in zip(keys, default, strict=True)] if isinstance(data, Mapping) else data
        numbers = isinstance(values, list) and len(values) == len(keys) and all(map(is_number, values))
        if not numbers or not np.isfinite(values).all():
            raise self.fail(where, data, f"expected {len(keys)} finite numbers")
        return np.array(values, float)


def inside(where: str, key: str) -> str:
    """Return the dotted path of a key inside a part of a file."""
    return f"{where}.{key}" if where else key
