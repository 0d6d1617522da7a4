"""Files of the point clouds that are put into a world as arrays."""

from __future__ import annotations

import io
import os
import tempfile
from collections import deque
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from apex_ompl.errors import ParameterError
from apex_ompl.util.files import write_atomically
from apex_ompl.util.validation import finite_array

KEPT = 10  # temporary files


class CloudFiles:
    """A folder for the last clouds of a world; it is made when it is needed, and removed with this object."""

    def __init__(self) -> None:
        """Make no folder yet."""
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._files: deque[Path] = deque()
        self._count = 0

    def write(self, points: ArrayLike, file: str | os.PathLike[str] | None) -> Path:
        """Write points, shape (N, 3) [m], to a file or to a temporary one, and return its path.

        Raises:
            ParameterError: The points have another shape, or are not finite, or the file is no ``.npy``.
            MissingFileError: The file cannot be written.
        """
        cloud = finite_array(points, "points")
        if cloud.ndim != 2 or cloud.shape[1] != 3:
            raise ParameterError("points", cloud.shape, "an array of shape (N, 3)")
        if file is None:
            path = self._next()
        else:
            path = Path(file)
            if path.suffix != ".npy":
                raise ParameterError("file", str(file), "a file name ending in .npy")
        content = io.BytesIO()
        np.save(content, cloud.astype(np.float32))
        write_atomically(path, content.getvalue())
        return path

    def _next(self) -> Path:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="apex_ompl-")
        self._count += 1
        path = Path(self._folder.name) / f"cloud-{self._count}.npy"
        self._files.append(path)
        while len(self._files) > KEPT:
            self._files.popleft().unlink(missing_ok=True)
        return path
