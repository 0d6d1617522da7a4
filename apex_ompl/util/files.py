"""Files: atomic writes, checks of paths, folders and locks, and NumPy archives of records."""

from __future__ import annotations

import contextlib
import fcntl
import io
import json
import os
import stat
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from apex_ompl.errors import FileFormatError, FolderInUseError, MissingFileError, ParameterError

OUTPUT = "output file"
BROKEN = (
    KeyError, TypeError, ValueError, EOFError, OverflowError, NotImplementedError, RuntimeError, MemoryError,
    tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Exceptions raised on reading a NumPy archive that is damaged or holds other content."""


def path_text(given: str | os.PathLike[str], name: str = "path") -> str:
    """Return the text of a path, or of a name, that a caller gives.

    Raises:
        ParameterError: It is neither a text nor a path.
    """
    text = os.fspath(given) if isinstance(given, (str, os.PathLike)) else None
    if not isinstance(text, str):
        raise ParameterError(name, given, "a path or a name")
    return text


def is_file(path: Path) -> bool:
    """Whether a path is an existing file; False also for names that no file can have, pipes and devices."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def check_readable(path: Path, role: str) -> None:
    """Check that a path is a regular file that can be read; reading a pipe or a device may never end.

    Args:
        path: The file.
        role: Description of the file for the error.

    Raises:
        MissingFileError: There is none, it may not be read, or it is a folder, a pipe or a device.
    """
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise MissingFileError(str(path), role, (error.strerror or "cannot be read").lower()) from error
    except ValueError as error:
        raise MissingFileError(str(path), role, "no file can have this name") from error
    if stat.S_ISDIR(mode):
        raise MissingFileError(str(path), role, "is a directory")
    if not stat.S_ISREG(mode):
        raise MissingFileError(str(path), role, "is a pipe or a device, expected a regular file")
    if not os.access(path, os.R_OK):
        raise MissingFileError(str(path), role, "permission denied")


def read_file(path: Path, role: str) -> bytes:
    """Return the content of a regular file.

    Args:
        path: The file.
        role: Description of the file for the error.

    Raises:
        MissingFileError: It cannot be read.
    """
    with opened(path, role) as file:
        return file.read()


@contextmanager
def opened(path: Path, role: str) -> Iterator[IO[bytes]]:
    """Open a regular file to read some of it.

    Args:
        path: The file.
        role: Description of the file for the error.

    Raises:
        MissingFileError: It cannot be read.
    """
    check_readable(path, role)
    try:
        with path.open("rb") as file:
            yield file
    except OSError as error:
        raise MissingFileError(str(path), role, (error.strerror or "cannot be read").lower()) from error


def read_text(path: Path, role: str) -> str:
    """Return the content of a text file in UTF-8, with or without a byte-order mark.

    Args:
        path: The file.
        role: Description of the file for the error.

    Raises:
        MissingFileError: It cannot be read.
        FileFormatError: It is not UTF-8 text.
    """
    try:
        return read_file(path, role).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(str(path), "", str(error.reason), "expected UTF-8 text") from error


def suffix_of(path: Path, known: Sequence[str]) -> str:
    """Return the suffix, such as ``.traj.yaml``, of an output file out of the known ones.

    Raises:
        ParameterError: The file has another suffix.
    """
    found = next((suffix for suffix in known if path.name.endswith(suffix) and path.name != suffix), None)
    if found is None:
        raise ParameterError("output", path.name, f"a file name ending in {', '.join(known)}")
    return found


def check_writable(path: Path) -> None:
    """Check that a file can be written, before its content is computed.

    Raises:
        MissingFileError: The folder does not exist or cannot be written, or the path is a folder.
    """
    try:
        if not path.parent.is_dir():
            raise MissingFileError(str(path), OUTPUT, f"folder {str(path.parent)!r} does not exist")
        if path.is_dir():
            raise MissingFileError(str(path), OUTPUT, "is a folder")
    except (OSError, ValueError) as error:
        raise MissingFileError(str(path), OUTPUT, "no file can have this name") from error
    if "\0" in str(path) or len(os.fsencode(path.name)) > 200:
        raise MissingFileError(str(path), OUTPUT, "no file can have this name")
    if not os.access(path.parent, os.W_OK):
        raise MissingFileError(str(path), OUTPUT, f"no permission to write in {str(path.parent)!r}")


def make_folder(folder: str | os.PathLike[str], role: str = "output folder") -> Path:
    """Make a folder and its parents, if they do not exist, and return its path.

    Args:
        folder: The folder.
        role: Description of the folder for errors.

    Raises:
        MissingFileError: It cannot be made.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        why = (getattr(error, "strerror", None) or str(error)).lower()
        raise MissingFileError(str(path), role, why) from error
    return path


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder against other processes inside the block.

    Args:
        folder: The folder.
        wait: Wait until another process has unlocked it.

    Raises:
        MissingFileError: The folder cannot be written.
        FolderInUseError: Another process has locked it.
    """
    try:
        file = open(folder / ".lock", "w")
    except OSError as error:
        raise MissingFileError(str(folder), "output folder", (error.strerror or "cannot be written").lower()) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            raise FolderInUseError(str(folder)) from error
        yield


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name in the same folder, then rename it.

    Raises:
        MissingFileError: The folder does not exist or cannot be written.
    """
    check_writable(path)
    temporary: str | None = None
    try:
        descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        why = (error.strerror or "cannot be written").lower()
        raise MissingFileError(str(path), OUTPUT, why) from error


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
