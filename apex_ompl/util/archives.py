"""NumPy archives of a record: its arrays, and the rest of it as JSON text."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError
from apex_ompl.util.files import BROKEN, read_file


def pack_archive(
    key: str, data: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], *, compressed: bool = False
) -> bytes:
    """Return the content of an archive.

    Args:
        key: Name of the JSON text in the archive.
        data: What the text holds.
        arrays: The arrays by name.
        compressed: Whether it is made small, which takes longer.
    """
    buffer, text = io.BytesIO(), np.array(json.dumps(data))
    (np.savez_compressed if compressed else np.savez)(buffer, **{key: text}, **dict(arrays))  # type: ignore[arg-type]
    return buffer.getvalue()


def read_archive(path: Path, key: str, role: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return the record and the arrays of an archive.

    Args:
        path: The file.
        key: Name of the JSON text in the archive.
        role: Description of the file for errors.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is no such archive.
    """
    try:
        with np.load(io.BytesIO(read_file(path, role)), allow_pickle=False) as archive:
            data = json.loads(str(archive[key]))
            if not isinstance(data, dict):
                raise ValueError("no mapping")
            return data, {name: archive[name] for name in archive.files if name != key}
    except (OSError, AttributeError, *BROKEN) as error:
        raise FileFormatError(str(path), "", str(error), f"expected a {role} that was saved") from error
