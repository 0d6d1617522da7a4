"""State of an interrupted training run, ``state.pt`` in the run's folder."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from apex_ompl.errors import FileFormatError
from apex_ompl.util.files import write_atomically

STATE = "state.pt"
KEYS = ("phase", "step", "number", "left", "seconds", "network", "averaged", "optimizer")
EXPECTED = "expected the state of a training run"


def write_state(folder: Path, digest: str, values: Mapping[str, Any]) -> None:
    """Write the state of a run.

    Args:
        folder: Folder of the run.
        digest: Digest of the settings and data that determine the trained weights.
        values: Values of :data:`KEYS`.

    Raises:
        MissingFileError: The file cannot be written.
    """
    stream = io.BytesIO()
    torch.save({"essence": digest, **{key: values[key] for key in KEYS}}, stream)
    write_atomically(folder / STATE, stream.getvalue())


def read_state(folder: Path, digest: str, device: torch.device) -> dict[str, Any]:
    """Read the state of a run.

    Raises:
        FileFormatError: The file is damaged, or of a run with other settings or data.
    """
    path = folder / STATE
    try:
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
        found = state["essence"]
    except Exception as error:  # zipfile and pickle let many kinds through
        raise FileFormatError(str(path), "", type(error).__name__, EXPECTED) from error
    if found != digest:
        expected = "expected the state of a run with this configuration and these data; take another folder"
        raise FileFormatError(str(path), "essence", found[:12], expected)
    return state
