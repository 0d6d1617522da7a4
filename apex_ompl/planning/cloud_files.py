"""Files of the clouds of points that a program puts into a world, so that results can name them."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import weakref
from collections.abc import Container
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.types import Array
from apex_ompl.util.files import path_text, write_atomically
from apex_ompl.util.validation import finite_array

KEPT_CLOUDS = 8  # temporary files that no obstacle has any more


class CloudFiles:
    """A folder for the last clouds of a world; it is made when it is needed, and removed with this object.

    It belongs to the process that made it: one that was forked from there makes a folder of its own.
    """

    def __init__(self) -> None:
        """Make no folder yet."""
        self._folder: Path | None = None
        self._process = 0  # that made the folder
        self._files: list[Path] = []
        self._count = 0

    def path(self, file: str | os.PathLike[str] | None) -> Path:
        """Return the path of a file that is named, or of the next temporary one.

        Raises:
            ParameterError: The file is no ``.npy``.
        """
        if file is not None:
            given = Path(path_text(file, "file"))
            if given.suffix != ".npy":
                raise ParameterError("file", str(file), "a file name ending in .npy")
            return given
        if self._folder is None or self._process != os.getpid():
            self._folder, self._process, self._files = Path(tempfile.mkdtemp(prefix="apex_ompl-")), os.getpid(), []
            weakref.finalize(self, _remove, self._folder, self._process)
        self._count += 1
        return self._folder / f"cloud-{self._count}.npy"

    def write(self, cloud: Array, path: Path, used: Container[str]) -> None:
        """Write points, shape (N, 3) [m], to one of the paths that :meth:`path` returns.

        Args:
            cloud: The points.
            path: Where to.
            used: Files that obstacles have, which are kept.

        Raises:
            MissingFileError: The file cannot be written.
        """
        content = io.BytesIO()
        np.save(content, cloud.astype(np.float32))
        write_atomically(path, content.getvalue())
        if path.parent == self._folder and self._process == os.getpid():
            self._files.append(path)
        free = [one for one in self._files if str(one) not in used and one != path]
        for one in free[:-KEPT_CLOUDS] if self._process == os.getpid() else ():
            self._files.remove(one)
            one.unlink(missing_ok=True)


def _remove(folder: Path, process: int) -> None:
    """Remove a folder in the process that made it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


def cloud_of(points: ArrayLike) -> Array:
    """Return points as an array of shape (N, 3) [m].

    Raises:
        ParameterError: They have another shape, or are not finite.
    """
    cloud = finite_array(points, "points")
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ParameterError("points", cloud.shape, "an array of shape (N, 3)")
    return cloud
