"""Files of a training run: its log, as CSV and for TensorBoard, and the state from which it is resumed."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from apex_ompl.errors import FileFormatError, MissingFileError
from apex_ompl.util.files import is_file, read_text, write_atomically

FIELDS = ("phase", "step", "loss", "held_out", "rate", "seconds", "sampled", "repaired", "levels")
PLOTTED = ("loss", "held_out", "rate", "sampled", "repaired")
FILE = "log.csv"
STATE = "state.pt"
KEYS = ("phase", "step", "number", "left", "seconds", "network", "averaged", "optimizer")
EXPECTED = "expected the state of a training run"


def read_log(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's log.

    Raises:
        MissingFileError: The file cannot be read.
        FileFormatError: It is not a log.
    """
    path = folder / FILE
    if not is_file(path):
        return []
    rows = list(csv.DictReader(io.StringIO(read_text(path, "log of a training run"), newline="")))
    if any(not (row.get("step") or "").isdecimal() or not row.get("phase") for row in rows):
        raise FileFormatError(str(path), "step", "no number", "expected the log of a training run")
    return rows


class RunLog:
    """Rows of numbers by phase and step."""

    def __init__(self, folder: Path, progress: Mapping[str, int]) -> None:
        """Append to the log in a folder; rows beyond the progress of a phase are removed.

        Args:
            folder: Folder of the run.
            progress: Last step of each phase.

        Raises:
            FileFormatError: The existing file is not a log.
            MissingFileError: It cannot be written.
        """
        self._path = folder / FILE
        rows = read_log(folder)
        kept = [row for row in rows if int(row["step"]) <= progress.get(row["phase"], -1)]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, FIELDS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(kept)
        write_atomically(self._path, text.getvalue().encode())
        self._board: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=max(progress.values(), default=0) + 1)

    def add(self, row: Mapping[str, str | int]) -> None:
        """Add a row.

        Raises:
            MissingFileError: It cannot be written.
        """
        try:
            with self._path.open("a", newline="") as file:
                csv.DictWriter(file, FIELDS).writerow(row)
        except OSError as error:
            raise MissingFileError(str(self._path), "log of a training run", str(error.strerror).lower()) from error
        if self._board is not None:
            for name in PLOTTED:
                if name in row:
                    self._board.add_scalar(f"{row['phase']}/{name}", float(row[name]), int(row["step"]))
            self._board.flush()


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
