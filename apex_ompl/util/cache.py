"""The folder in the user's cache where this package keeps files that it can make again."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path


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


def _holds_files(folder: Path) -> bool:
    try:
        return any(folder.iterdir())
    except OSError:
        return False
