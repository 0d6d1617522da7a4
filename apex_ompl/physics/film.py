"""Films of tasks in physics; needs the extra ``viz`` (imageio)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apex_ompl.errors import MissingFileError
from apex_ompl.physics.execution import FILM_RATE
from apex_ompl.util.files import write_atomically

FILMS = (".mp4",)


def save_film(path: Path, frames: Sequence[Any]) -> None:
    """Write frames, each of shape (height, width, 3) and type uint8, as an .mp4 file.

    Raises:
        MissingFileError: The extra ``viz`` is not installed, or the folder is missing or cannot be written.
    """
    try:
        import imageio.v3 as iio
    except ImportError as error:
        raise MissingFileError("imageio", "package for films", "install apex-ompl[viz]") from error
    data = iio.imwrite("<bytes>", np.stack(frames), extension=".mp4", fps=FILM_RATE, codec="libx264")
    write_atomically(path, bytes(data))
