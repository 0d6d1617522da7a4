"""Caches: results kept with the object that they belong to, results kept by key, and files in the user's cache."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import update_wrapper
from pathlib import Path
from typing import Any, Generic, TypeVar
from weakref import ref

from numpy.typing import NDArray

from apex_ompl.errors import ApexError
from apex_ompl.util.files import is_file, pack_archive, read_archive, write_atomically

ABOUT = "about"  # the record in a file
MOST_FILES = 64  # of arrays in a folder; those that were used least lately are removed

LOG = logging.getLogger("apex_ompl")

R = TypeVar("R")
Arrays = Mapping[str, NDArray[Any]]


class weakly_cached(Generic[R]):  # noqa: N801 - a decorator
    """Keep the results of a function of one object, which must not change, until the object is deleted.

    Objects are distinguished by identity, because Coal's objects compare their whole content.
    """

    def __init__(self, function: Callable[[Any], R]) -> None:
        """Wrap a function."""
        self._function = function
        self._kept: dict[int, tuple[ref[Any], R]] = {}
        update_wrapper(self, function)

    def __call__(self, item: Any) -> R:
        """Return the kept result, or that of the function."""
        found = self._kept.get(id(item))
        if found is not None and found[0]() is item:
            return found[1]
        result = self._function(item)
        self.keep(item, result)
        return result

    def keep(self, item: Any, result: R) -> None:
        """Keep a known result."""
        number = id(item)
        self._kept[number] = ref(item, lambda _: self._kept.pop(number, None)), result


def kept(results: dict[str, R], key: str, make: Callable[[], R], most: int) -> R:
    """Return the result of a key, made where there is none; beyond ``most`` results the oldest are dropped."""
    if (known := results.get(key)) is not None:  # another thread may drop it
        return known
    result = make()
    while len(results) >= most:
        results.pop(next(iter(results)), None)
    results[key] = result
    return result


def user_cache(name: str, homes: Sequence[str] = (), *, or_filled: bool = False) -> Path | None:
    """Return a folder of this package in the user's cache, made if need be, or None when none can be written.

    Args:
        name: Name of the folder.
        homes: Folders to be tried before the user's cache.
        or_filled: Whether one that holds files and cannot be written will do, as in an image that another user built.
    """
    for home in (*homes, os.environ.get("XDG_CACHE_HOME") or "~/.cache"):
        try:
            folder = Path(home).expanduser() / "apex_ompl" / name
        except RuntimeError:  # the user has no home folder
            continue
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            if not (or_filled and _holds_files(folder)):
                continue
        return folder
    return None


def has_room(folder: Path, size: int) -> bool:
    """Whether a file of so many bytes can be written into a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(size))
    except OSError:
        return False
    return True


def stored(
    folder: str,
    name: str,
    make: Callable[[], tuple[dict[str, Any], Arrays]],
    read: Callable[[dict[str, Any], dict[str, NDArray[Any]]], R],
) -> R:
    """Return arrays, and a record that goes with them, from the user's cache; they are made where it has none.

    A file that is damaged or cut off is made anew, and a cache that cannot be written, or is full, is done without.
    Processes may use a file at the same time.

    Args:
        folder: Name of the folder in the cache.
        name: Name of the file, which must be a digest of all that its content depends on.
        make: Makes the record, as of JSON, and the arrays.
        read: Returns what they stand for.
    """
    home = user_cache(folder, or_filled=True)
    path = None if home is None else home / f"{name}.npz"
    if path is not None and is_file(path):
        try:
            found = read(*read_archive(path, ABOUT, "file of the cache"))
        except Exception as error:  # NumPy, zipfile and what reads the content let many kinds through
            LOG.warning("apex_ompl makes a file of its cache anew, which is damaged: %s", error)
        else:
            with suppress(OSError):  # it belongs to another user, or was removed meanwhile
                os.utime(path)
            return found
    about, arrays = make()
    if path is not None:
        try:
            write_atomically(path, pack_archive(ABOUT, about, arrays))
            _remove_oldest(path.parent)
        except (ApexError, OSError) as error:
            LOG.info("apex_ompl cannot keep a file of its cache: %s", error)
    return read(about, dict(arrays))


def _remove_oldest(folder: Path) -> None:
    """Remove the files of arrays that were used least lately, beyond ``MOST_FILES``."""
    times = []
    for file in folder.glob("*.npz"):
        with suppress(OSError):  # another process has removed it
            times.append((file.stat().st_mtime_ns, file))
    for _, file in sorted(times)[:-MOST_FILES]:
        with suppress(OSError):
            file.unlink()


def _holds_files(folder: Path) -> bool:
    try:
        return any(folder.iterdir())
    except OSError:
        return False
