"""The folder in the user's cache where this package keeps files that it can make again."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path


def user_cache(name: str, homes: Sequence[str] = ()) -> Path | None:
    """Return a folder of this package in the user's cache, made if need be, or None when none can be written.

    Args:
        name: Name of the folder.
        homes: Folders to be tried before the user's cache.
    """
    for home in (*homes, os.environ.get("XDG_CACHE_HOME") or "~/.cache"):
        try:
            folder = Path(home).expanduser() / "apex_ompl" / name
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except (OSError, RuntimeError):  # RuntimeError: the user has no home folder
            continue
        return folder
    return None
