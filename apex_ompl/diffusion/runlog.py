"""The log of a training run: a CSV file, and TensorBoard's where that is installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from apex_ompl.files import is_file, write_atomically

FIELDS = ("phase", "step", "loss", "held_out", "rate", "seconds", "sampled", "repaired", "levels")
PLOTTED = ("loss", "held_out", "rate", "sampled", "repaired")


class RunLog:
    """Rows of numbers by phase and step."""

    def __init__(self, folder: Path) -> None:
        """Write into a folder."""
        self.path, self.board = folder / "log.csv", folder / "tensorboard"

    def rows(self) -> list[dict[str, str]]:
        """Return what was logged."""
        if not is_file(self.path):
            return []
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))

    def cut(self, phases: Mapping[str, int]) -> None:
        """Forget rows behind the last step of each phase; phases that are not named have not begun."""
        rows = self.rows()
        kept = [row for row in rows if int(row["step"] or 0) <= phases.get(row["phase"], -1)]
        if len(kept) < len(rows):
            text = io.StringIO(newline="")
            writer = csv.DictWriter(text, FIELDS)
            writer.writeheader()
            writer.writerows(kept)
            write_atomically(self.path, text.getvalue().encode())

    def add(self, row: Mapping[str, str | int]) -> None:
        """Add a row."""
        new = not is_file(self.path)
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            if new:
                writer.writeheader()
            writer.writerow(row)
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        with SummaryWriter(str(self.board)) as board:
            for name in PLOTTED:
                if name in row:
                    board.add_scalar(f"{row['phase']}/{name}", float(row[name]), int(row["step"]))
